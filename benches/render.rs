//! How fast pictures are made: `cargo bench --bench render [-- POINTS]`.
//!
//! A furnished room of 2 million points (or as many as are asked for), once as an octree, a disc a
//! point, once as a map with a surfel a point and no links, 1920x1080 pixels, seen from outside and
//! from within. A row a picture: seconds to draw it and to write its PNG into memory, the median
//! of five. Run as a test, with few points.

use std::time::Instant;

use pvmap::render::{
    Camera, ColorBy, Lens, MapSplats, OctreeSplats, Paint, Side, Size, Source, Style, View, bounds,
    render,
};
use pvmap::scene::{Scene, SceneKind};
use pvmap::scenes::{self, SceneRequest};
use pvmap::vmap::{MapView, OctreeView};
use pvmap::{BuildConfig, IngestRequest, Limits, Mapped, Quiet};

const RUNS: usize = 5;
const SIZE: Size = Size { width_px: 1920, height_px: 1080 };
/// In the room's front corner, a man's height above the floor.
const INSIDE: View = View {
    eye: [0.4, 0.4, 1.7],
    target: [4.0, 4.0, 1.5],
    up: [0.0, 0.0, 1.0],
    lens: Lens::Perspective { fov_deg: 70.0 },
};

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    let as_test = !arguments.iter().any(|a| a == "--bench");
    let asked = arguments.iter().skip(1).find_map(|a| a.parse::<u64>().ok());
    let n_points = asked.unwrap_or(if as_test { 3000 } else { 2_000_000 });
    let folder = tempfile::tempdir()?;
    let file = |name: &str| folder.path().join(name);
    let scene = Scene::new(SceneKind::Furnished, 1);
    let request = SceneRequest { n_points, shuffle: false };
    let limits = Limits::default();
    scenes::write(&scene, &request, &file("room.ply"), &limits, &Quiet)?;
    let ingest = IngestRequest::new([file("room.ply")], file("room.octree"));
    pvmap::ingest(&ingest, &limits, &Quiet)?;
    let config = BuildConfig {
        max_level: 21,
        leaf_capacity: 1,
        // No pairs to start from: a tree as any other, and no links.
        interaction: Some(Vec::new()),
        ..BuildConfig::default()
    };
    pvmap::build(&file("room.octree"), &file("room.vmap"), &config, &limits, &Quiet)?;
    let (octree, map) =
        (pvmap::open_octree(&file("room.octree"))?, Mapped::open(&file("room.vmap"))?);
    let (octree, map) = (OctreeView::open(&octree)?, MapView::open(&map)?);
    let frame = &octree.frame().frame;
    let points = OctreeSplats::new(&octree, None, Paint::new(ColorBy::Rgb, None), 1.0)?;
    let surfels = MapSplats::new(&map, Paint::new(ColorBy::Rgb, None), 1.0)?;
    println!("{:<10}{:>12}{:>10}{:>10}{:>10}", "", "splats", "view", "draw s", "PNG s");
    for (name, splats) in [("points", &points as &dyn Source), ("surfels", &surfels)] {
        let around = bounds(splats)?.unwrap_or_default();
        let lens = Lens::Perspective { fov_deg: 40.0 };
        let up = [0.0, 0.0, 1.0];
        let outside = View::of_box(around, Side::Corner, up, lens, SIZE, frame)?;
        for (place, view) in [("outside", outside), ("inside", INSIDE)] {
            let camera = Camera::new(&view, SIZE, frame)?;
            let [drawn, written] = median(splats, &camera, if as_test { 1 } else { RUNS })?;
            let n = splats.n_splats();
            println!("{name:<10}{n:>12}{place:>10}{drawn:>10.3}{written:>10.3}");
        }
    }
    Ok(())
}

/// Draws and writes a picture some times over; gives the medians in seconds.
fn median(splats: &dyn Source, camera: &Camera, n_runs: usize) -> anyhow::Result<[f64; 2]> {
    let style = Style { background: [255; 3], cull_back: true, shade: 0.3 };
    let mut seconds = [Vec::new(), Vec::new()];
    for _ in 0..n_runs {
        let started = Instant::now();
        let picture = render(splats, camera, &style, &mut |_| true)?;
        seconds[0].push(started.elapsed().as_secs_f64());
        let started = Instant::now();
        picture.write_png(&mut Vec::new())?;
        seconds[1].push(started.elapsed().as_secs_f64());
    }
    Ok(seconds.map(|mut s| {
        s.sort_by(f64::total_cmp);
        s[s.len() / 2]
    }))
}
