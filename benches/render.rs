//! How fast pictures are made: `cargo bench --bench render [-- POINTS]`.
//!
//! A furnished room of 8 million points (or as many as are asked for), once as an octree, a disc a
//! point, once as a map with some 2 million surfels and no links, whose patches cover the room;
//! 1920x1080 pixels, seen from outside and from within. A row a picture: seconds to open the file
//! and draw, and to write the PNG into memory, the medians of five, and how much of the room seen
//! from within is covered: no picture is timed that has holes. Run as a test, with few points.

use std::time::Instant;

use pvmap::geometry::Frame;
use pvmap::render::{
    Camera, ColorBy, Lens, MapSplats, OctreeSplats, Paint, Picture, Side, Size, Source, Style,
    View, render,
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
    let n_points = asked.unwrap_or(if as_test { 30_000 } else { 8_000_000 });
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
        leaf_capacity: 8,
        // No pairs to start from: a tree as any other, and no links.
        interaction: Some(Vec::new()),
        ..BuildConfig::default()
    };
    pvmap::build(&file("room.octree"), &file("room.vmap"), &config, &limits, &Quiet)?;
    let (octree_bytes, map_bytes) =
        (pvmap::open_octree(&file("room.octree"))?, Mapped::open(&file("room.vmap"))?);
    println!("{:<10}{:>12}{:>10}{:>10}{:>10}", "", "splats", "view", "draw s", "PNG s");
    for of_points in [true, false] {
        let name = if of_points { "points" } else { "surfels" };
        // What opens it is timed, too.
        let draw = |of: &mut dyn FnMut(&dyn Source, &Frame) -> anyhow::Result<()>| {
            let paint = Paint::new(ColorBy::Rgb, None);
            if of_points {
                let octree = OctreeView::open(&octree_bytes)?;
                of(&OctreeSplats::new(&octree, None, paint, 1.0)?, &octree.frame().frame)
            } else {
                let map = MapView::open(&map_bytes)?;
                of(&MapSplats::new(&map, paint, 1.0)?, &map.frame().frame)
            }
        };
        let mut n_splats = 0;
        let mut views = vec![("inside", INSIDE)];
        draw(&mut |splats, frame| {
            n_splats = splats.n_splats();
            let lens = Lens::Perspective { fov_deg: 40.0 };
            let outside = View::fitting(splats, Side::Corner, [0.0, 0.0, 1.0], lens, SIZE, frame)?;
            views.push(("outside", outside));
            let covered = covered(&picture(splats, frame, &INSIDE)?);
            anyhow::ensure!(covered > 0.999, "{name}: only {covered} covered from within");
            Ok(())
        })?;
        for (place, view) in views {
            let mut seconds = [Vec::new(), Vec::new()];
            for _ in 0..if as_test { 1 } else { RUNS } {
                let started = Instant::now();
                let mut drawn = None;
                draw(&mut |splats, frame| {
                    drawn = Some(picture(splats, frame, &view)?);
                    Ok(())
                })?;
                seconds[0].push(started.elapsed().as_secs_f64());
                let started = Instant::now();
                drawn.iter().try_for_each(|picture| picture.write_png(&mut Vec::new()))?;
                seconds[1].push(started.elapsed().as_secs_f64());
            }
            let [drawn, written] = seconds.map(median);
            println!("{name:<10}{n_splats:>12}{place:>10}{drawn:>10.3}{written:>10.3}");
        }
    }
    Ok(())
}

fn picture(splats: &dyn Source, frame: &Frame, view: &View) -> anyhow::Result<Picture> {
    let camera = Camera::new(view, SIZE, frame)?;
    let style = Style { background: [255; 3], cull_back: true, shade: 0.3 };
    Ok(render(splats, &camera, &style, 1 << 30, &mut |_| true)?)
}

/// Gives the share of the pixels that have something in them.
fn covered(picture: &Picture) -> f64 {
    let (width, height) = (SIZE.width_px, SIZE.height_px);
    let each = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let n = each.filter(|&(x, y)| picture.is_covered(x, y)).count();
    n as f64 / (f64::from(width) * f64::from(height))
}

fn median(mut seconds: Vec<f64>) -> f64 {
    seconds.sort_by(f64::total_cmp);
    seconds[seconds.len() / 2]
}
