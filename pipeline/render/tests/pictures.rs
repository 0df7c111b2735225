//! Pictures of a few splats, held against plain geometry.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

use std::ops::Range;

use pvmap_geometry::{Frame, grid};
use pvmap_render::{
    Camera, Clipped, Lens, Picture, RenderError, Shape, Side, Size, Source, Splat, Style, View,
    held_bytes, render, srgb,
};

/// Splats in memory.
struct Few(Vec<Splat>);

impl Source for Few {
    fn n_splats(&self) -> u64 {
        self.0.len() as u64
    }

    fn read(&self, range: Range<u64>, out: &mut Vec<Splat>) -> Result<(), RenderError> {
        out.extend(&self.0[range.start as usize..range.end as usize]);
        Ok(())
    }
}

const SIZE: Size = Size { width_px: 160, height_px: 120 };
const MEMORY: u64 = 1 << 30;
const RED: [u8; 3] = [200, 30, 20];
const BLUE: [u8; 3] = [20, 40, 210];
const WHITE: [u8; 3] = [255; 3];
const PLAIN: Style = Style { background: WHITE, cull_back: true, shade: 0.0 };
const SQUARE: Lens = Lens::Perspective { fov_deg: 90.0 };

/// A frame in which a world unit is a grid step.
fn frame() -> Frame {
    let side = f64::from(grid::GRID_MAX);
    Frame::of_world([0.0; 3], [side; 3])
}

/// Looks along +y from `eye`, z up.
fn ahead(eye: [f64; 3], lens: Lens) -> Camera {
    let target = [eye[0], eye[1] + 1.0, eye[2]];
    let view = View { eye, target, up: [0.0, 0.0, 1.0], lens };
    Camera::new(&view, SIZE, &frame()).unwrap()
}

fn disc(centre: [f32; 3], normal: [f32; 3], radius: f32, color: [u8; 3]) -> Splat {
    let length = normal.iter().map(|v| v * v).sum::<f32>().sqrt();
    let normal = if length > 0.0 { normal.map(|v| v / length) } else { normal };
    let (shape, noise) = (Shape::Round(radius), radius * 2.0 / 3.0);
    Splat { centre, normal, shape, noise, two_sided: false, color: srgb(color), glossy: None }
}

fn draw(splats: &[Splat], camera: &Camera, style: &Style) -> Picture {
    render(&Few(splats.to_vec()), camera, style, MEMORY, &mut |_| true).unwrap()
}

fn pixels() -> impl Iterator<Item = (u32, u32)> {
    (0..SIZE.height_px).flat_map(|y| (0..SIZE.width_px).map(move |x| (x, y)))
}

fn count(picture: &Picture) -> usize {
    pixels().filter(|&(x, y)| picture.is_covered(x, y)).count()
}

const EYE: [f64; 3] = [1000.0, 0.0, 1000.0];
const TOWARDS: [f32; 3] = [0.0, -1.0, 0.0];

/// Where the ray of a pixel meets the plane of a splat, from its middle; world axes.
fn hit(lens: Lens, splat: &Splat, x: u32, y: u32) -> [f64; 3] {
    let across = f64::from(x) + 0.5 - f64::from(SIZE.width_px) / 2.0;
    let up = f64::from(SIZE.height_px) / 2.0 - f64::from(y) - 0.5;
    let (from, ray) = match lens {
        Lens::Perspective { fov_deg } => {
            let focal = f64::from(SIZE.height_px) / 2.0 / (fov_deg.to_radians() / 2.0).tan();
            (EYE, [across / focal, 1.0, up / focal])
        }
        Lens::Orthographic { width } => {
            let step = width / f64::from(SIZE.width_px);
            ([EYE[0] + across * step, EYE[1], EYE[2] + up * step], [0.0, 1.0, 0.0])
        }
    };
    let n = splat.normal.map(f64::from);
    let off = [0, 1, 2].map(|i| f64::from(splat.centre[i]) - from[i]);
    let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|i| a[i] * b[i]).sum::<f64>();
    let t = dot(off, n) / dot(ray, n);
    [0, 1, 2].map(|i| t * ray[i] - off[i])
}

#[test]
fn a_splat_covers_the_pixels_whose_rays_meet_it() {
    let tilted = [0.5, -0.7, 0.3];
    let centre = [1020.0, 100.0, 990.0];
    for lens in [SQUARE, Lens::Orthographic { width: 200.0 }] {
        let camera = ahead(EYE, lens);
        let round = disc(centre, tilted, 30.0, RED);
        let (low, high) = ([-25.0, -9.0, -15.0], [20.0, 19.0, 30.0]);
        let square = Splat { shape: Shape::Box([low, high]), ..round };
        let oval = Splat { shape: Shape::Ellipse([30.0, 15.0, 25.0]), ..round };
        for splat in [round, square, oval] {
            let picture = draw(&[splat], &camera, &PLAIN);
            let mut n_inside = 0;
            for (x, y) in pixels() {
                let p = hit(lens, &splat, x, y);
                let share = match splat.shape {
                    Shape::Round(radius) => {
                        p.map(|v| v * v).iter().sum::<f64>().sqrt() / f64::from(radius)
                    }
                    Shape::Box([low, high]) => (0..3)
                        .map(|i| (p[i] / f64::from(low[i])).max(p[i] / f64::from(high[i])))
                        .fold(0.0, f64::max),
                    Shape::Ellipse(half) => {
                        (0..3).map(|i| (p[i] / f64::from(half[i])).powi(2)).sum::<f64>().sqrt()
                    }
                };
                n_inside += usize::from(share < 1.0);
                if (share - 1.0).abs() > 1e-4 {
                    assert_eq!(picture.is_covered(x, y), share < 1.0, "{x} {y} {share}");
                    let is_far = share > 1.5;
                    assert!(!is_far || picture.pixel(x, y) == WHITE, "{x} {y} {share}");
                }
                if share < 1.0 - 1e-4 {
                    assert_eq!(picture.pixel(x, y), RED);
                }
            }
            assert!(n_inside > 300, "{n_inside}");
        }
    }
}

#[test]
fn a_disc_in_front_hides_the_one_behind() {
    let camera = ahead(EYE, SQUARE);
    let (front, back) = (
        disc([1000.0, 100.0, 1000.0], TOWARDS, 20.0, RED),
        disc([1000.0, 200.0, 1000.0], TOWARDS, 100.0, BLUE),
    );
    let alone = draw(&[front], &camera, &PLAIN);
    for order in [[front, back], [back, front]] {
        let picture = draw(&order, &camera, &PLAIN);
        for (x, y) in pixels() {
            if alone.is_covered(x, y) {
                assert_eq!(picture.pixel(x, y), RED);
            } else if alone.pixel(x, y) == WHITE && picture.is_covered(x, y) {
                assert_eq!(picture.pixel(x, y), BLUE);
            }
        }
        // Between the two is a soft edge, neither the one nor the other.
        let is_soft = |x, y| ![RED, BLUE, WHITE].contains(&picture.pixel(x, y));
        let n_soft = pixels()
            .filter(|&(x, y)| alone.pixel(x, y) != WHITE && !alone.is_covered(x, y))
            .filter(|&(x, y)| is_soft(x, y))
            .count();
        assert!(n_soft > 30, "{n_soft}");
    }
}

#[test]
fn what_is_twice_as_far_is_half_as_large_but_not_without_perspective() {
    let at = |y: f32| disc([1000.0, y, 1000.0], TOWARDS, 30.0, RED);
    let n = |lens, y| count(&draw(&[at(y)], &ahead(EYE, lens), &PLAIN)) as f64;
    let ratio = n(SQUARE, 60.0) / n(SQUARE, 120.0);
    assert!((3.9..4.1).contains(&ratio), "{ratio}");
    let flat = Lens::Orthographic { width: 150.0 };
    assert_eq!(n(flat, 60.0), n(flat, 120.0));
    let area = std::f64::consts::PI * (30.0f64 * 160.0 / 150.0).powi(2);
    assert!((n(flat, 60.0) / area - 1.0).abs() < 0.01);
}

#[test]
fn where_nothing_is_is_background() {
    let camera = ahead(EYE, SQUARE);
    let behind = disc([1000.0, -50.0, 1000.0], [0.0, 1.0, 0.0], 20.0, RED);
    let away = disc([1000.0, 50.0, 1000.0], [0.0, 1.0, 0.0], 20.0, RED);
    for splats in [&[][..], &[behind], &[away]] {
        let picture = draw(splats, &camera, &Style { background: BLUE, ..PLAIN });
        assert!(pixels().all(|(x, y)| picture.pixel(x, y) == BLUE));
        assert_eq!(count(&picture), 0);
    }
    let all = Style { cull_back: false, ..PLAIN };
    assert!(count(&draw(&[away], &camera, &all)) > 300);
    assert!(count(&draw(&[Splat { two_sided: true, ..away }], &camera, &PLAIN)) > 300);
}

#[test]
fn a_splat_too_small_or_too_thin_for_the_rays_is_seen() {
    let camera = ahead(EYE, SQUARE);
    for k in 0..40 {
        let centre = [1000.0 + k as f32 * 0.37, 100.0, 1000.0 - k as f32 * 0.53];
        let edge_on = disc(centre, [1.0, 0.0, 0.0], 10.0, RED);
        for splat in [disc(centre, TOWARDS, 1e-3, RED), Splat { two_sided: true, ..edge_on }] {
            assert!((1..60).contains(&count(&draw(&[splat], &camera, &PLAIN))));
        }
    }
}

#[test]
fn a_disc_at_the_eye_covers_everything() {
    let near = disc([1000.0, 1.0, 1000.0], TOWARDS, 1000.0, RED);
    let slanted = disc([1000.0, 1.0, 1000.0], [0.0, -1.0, 1.0], 1000.0, RED);
    let camera = ahead(EYE, SQUARE);
    assert_eq!(count(&draw(&[near], &camera, &PLAIN)), 160 * 120);
    // From the middle of the picture down; above the plane is behind the eye or far away.
    assert!(count(&draw(&[slanted], &camera, &PLAIN)) > 160 * 60);
}

#[test]
fn what_begins_behind_the_eye_is_seen_where_it_reaches_before_it() {
    let camera = ahead(EYE, SQUARE);
    // A floor whose middle is under or behind the eye: it covers what is below the horizon, as far
    // as it reaches.
    let floor = |y: f32, shape| {
        let splat = disc([1000.0, y, 900.0], [0.0, 0.0, 1.0], 1.0, RED);
        draw(&[Splat { shape, ..splat }], &camera, &PLAIN)
    };
    for shape in [
        Shape::Round(4000.0),
        Shape::Box([[-4000.0; 3], [4000.0; 3]]),
        Shape::Ellipse([4000.0, 4000.0, 9.0]),
    ] {
        for y in [1.0, 0.0, -1.0, -500.0] {
            let picture = floor(y, shape);
            for (x, y) in pixels() {
                // Below the horizon's row 60 by 3 pixels: 2000 steps away.
                assert!(y < 64 || picture.pixel(x, y) == RED, "{shape:?} {x} {y}");
                assert!(y > 57 || picture.pixel(x, y) == WHITE, "{shape:?} {x} {y}");
            }
        }
        assert_eq!(count(&floor(-4001.0, shape)), 0);
    }
}

/// Points at random on a wall before a second wall.
fn walls(n: usize, radius: f32) -> Vec<Splat> {
    let mut rng = fastrand::Rng::with_seed(7);
    let mut splats = Vec::new();
    for (y, color) in [(100.0, RED), (150.0, BLUE)] {
        for _ in 0..n {
            let x = 1000.0 + (rng.f32() - 0.5) * 600.0;
            let z = 1000.0 + (rng.f32() - 0.5) * 500.0;
            splats.push(disc([x, y + rng.f32() * 0.2, z], TOWARDS, radius, color));
        }
    }
    splats
}

#[test]
fn a_wall_has_no_speckle() {
    // Three half spacings, as points of an octree get: e^-7 of it may be bare.
    let n = 20_000;
    let radius = 1.5 * (600.0f32 * 500.0 / n as f32).sqrt();
    let picture = draw(&walls(n, radius), &ahead(EYE, SQUARE), &PLAIN);
    let n_other = pixels().filter(|&(x, y)| picture.pixel(x, y) != RED).count();
    assert!(n_other < 160 * 120 / 500, "{n_other}");
    assert_eq!(count(&picture), 160 * 120);
}

#[test]
fn a_mirrored_scene_gives_a_mirrored_picture() {
    let mut rng = fastrand::Rng::with_seed(3);
    let mut number = |scale: f32| (rng.f32() - 0.5) * scale;
    let splats: Vec<Splat> = (0..300)
        .map(|i| {
            let centre = [1000.0 + number(200.0), 130.0 + number(100.0), 1000.0 + number(150.0)];
            let color = [RED, BLUE, [20, 200, 90]][i % 3];
            let normal = [number(2.0), number(2.0) - 1.0, number(2.0)];
            Splat { two_sided: true, ..disc(centre, normal, 4.0 + number(6.0), color) }
        })
        .collect();
    let mirrored: Vec<Splat> = splats
        .iter()
        .map(|s| {
            let ([x, y, z], [nx, ny, nz]) = (s.centre, s.normal);
            Splat { centre: [2000.0 - x, y, z], normal: [-nx, ny, nz], ..*s }
        })
        .collect();
    for lens in [SQUARE, Lens::Orthographic { width: 180.0 }] {
        let camera = ahead(EYE, lens);
        let (one, other) = (draw(&splats, &camera, &PLAIN), draw(&mirrored, &camera, &PLAIN));
        let mut n_off = 0;
        for (x, y) in pixels() {
            let (a, b) = (one.pixel(x, y), other.pixel(SIZE.width_px - 1 - x, y));
            n_off += usize::from((0..3).any(|i| a[i].abs_diff(b[i]) > 1));
        }
        // 2000 - x is rounded: a rim may fall on the other side of a pixel's middle.
        assert!(n_off < 8, "{n_off}");
        assert!(count(&one) > 2000);
    }
}

#[test]
fn threads_and_memory_change_no_byte() {
    // More than a block.
    let splats = Few(walls(90_000, 3.0));
    let camera = ahead(EYE, SQUARE);
    let style = Style { shade: 0.5, ..PLAIN };
    let png = |n_threads, memory| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
        let mut bytes = Vec::new();
        let picture = pool.install(|| render(&splats, &camera, &style, memory, &mut |_| true));
        picture.unwrap().write_png(&mut bytes).unwrap();
        bytes
    };
    let one = png(1, MEMORY);
    assert!(one.starts_with(b"\x89PNG\r\n\x1a\n"));
    assert!([2, 3, 8].into_iter().all(|n| png(n, MEMORY) == one));
    // One block of two is kept, and none.
    let held = held_bytes(SIZE);
    assert!([held + (24 << 20), 0].into_iter().all(|memory| png(2, memory) == one));
}

#[test]
fn bad_cameras_are_refused() {
    let up = [0.0, 0.0, 1.0];
    let good = View { eye: EYE, target: [1000.0, 9.0, 1000.0], up, lens: SQUARE };
    let refused = |view: View, size: Size| {
        let e = Camera::new(&view, size, &frame()).unwrap_err();
        assert!(e.is_usage(), "{e}");
        assert!(!e.to_string().contains('\n'));
    };
    assert!(Camera::new(&good, SIZE, &frame()).is_ok());
    refused(View { target: EYE, ..good }, SIZE);
    refused(View { up: [0.0, -3.0, 0.0], ..good }, SIZE);
    refused(View { up: [0.0; 3], ..good }, SIZE);
    refused(View { eye: [f64::NAN, 0.0, 0.0], ..good }, SIZE);
    refused(View { target: [f64::INFINITY, 0.0, 0.0], ..good }, SIZE);
    for fov_deg in [0.0, -1.0, 171.0, f64::NAN] {
        refused(View { lens: Lens::Perspective { fov_deg }, ..good }, SIZE);
    }
    for width in [0.0, -2.0, f64::NAN, f64::INFINITY] {
        refused(View { lens: Lens::Orthographic { width }, ..good }, SIZE);
    }
    for (width_px, height_px) in [(0, 5), (5, 0), (16_385, 5), (5, u32::MAX)] {
        refused(good, Size { width_px, height_px });
    }
}

#[test]
fn a_default_view_holds_the_whole_scan() {
    let sides =
        [Side::Corner, Side::Front, Side::Back, Side::Left, Side::Right, Side::Top, Side::Bottom];
    let corners = (0..8).map(|i| {
        let at = |axis: usize, low, high| if i >> axis & 1 == 0 { low } else { high };
        [at(0, 100.0, 900.0), at(1, 50.0, 1500.0), at(2, 7.0, 300.0)]
    });
    // No normals: they face every camera.
    let splats: Vec<Splat> = corners.map(|c| disc(c, [0.0; 3], 1.0, RED)).collect();
    for (side, up) in sides.into_iter().flat_map(|s| [(s, [0.0, 0.0, 2.0]), (s, [0.0, 1.0, 0.0])]) {
        for lens in [Lens::Perspective { fov_deg: 40.0 }, Lens::Orthographic { width: 0.0 }] {
            let all = Few(splats.clone());
            let view = View::fitting(&all, side, up, lens, SIZE, &frame()).unwrap();
            let camera = Camera::new(&view, SIZE, &frame()).unwrap();
            let what = format!("{side:?} {up:?} {lens:?}");
            for splat in &splats {
                let picture = draw(std::slice::from_ref(splat), &camera, &PLAIN);
                assert!(count(&picture) > 0, "{what} {:?}", splat.centre);
            }
            // Nowhere is more free than it must be: on one axis both edges are near.
            let picture = draw(&splats, &camera, &PLAIN);
            let covered = |x: u32, y: u32| picture.is_covered(x, y);
            let free_x =
                (0..SIZE.width_px).position(|x| (0..SIZE.height_px).any(|y| covered(x, y)));
            let free_y =
                (0..SIZE.height_px).position(|y| (0..SIZE.width_px).any(|x| covered(x, y)));
            let share = |free: Option<usize>, all: u32| free.unwrap() as f64 / f64::from(all);
            let least = share(free_x, SIZE.width_px).min(share(free_y, SIZE.height_px));
            assert!(least < 0.06, "{what}: {least} is free");
        }
    }
    // Nothing is a picture, too.
    let view = View::fitting(
        &Few(Vec::new()),
        Side::Corner,
        [0.0, 0.0, 1.0],
        Lens::Perspective { fov_deg: 40.0 },
        SIZE,
        &frame(),
    );
    Camera::new(&view.unwrap(), SIZE, &frame()).unwrap();
}

#[test]
fn marks_are_dots_or_rings_where_hidden() {
    let camera = ahead(EYE, SQUARE);
    let wall = disc([1000.0, 100.0, 1000.0], TOWARDS, 50.0, RED);
    let green = [0, 255, 0];
    let mark = |y: f64| {
        let mut picture = draw(&[wall], &camera, &PLAIN);
        assert!(picture.mark(&camera, [1000.0, y, 1000.0], 0.5, green));
        picture
    };
    assert_eq!(mark(50.0).pixel(80, 60), green);
    assert_eq!(mark(100.0).pixel(80, 60), green);
    let hidden = mark(200.0);
    assert!((0..3).all(|i| hidden.pixel(80, 60)[i].abs_diff(RED[i]) < 8));
    assert!((81..90).any(|x| hidden.pixel(x, 60)[1] > 200));
    let mut picture = draw(&[wall], &camera, &PLAIN);
    let before = picture.clone();
    for out in [[1000.0, -5.0, 1000.0], [5000.0, 100.0, 1000.0]] {
        assert!(!picture.mark(&camera, out, 0.0, green));
    }
    assert_eq!(picture, before);
}

#[test]
fn a_legend_is_drawn_where_there_is_room() {
    let camera = ahead(EYE, SQUARE);
    for (min, max) in [(0.0, 1.0), (-1.5e-7, 123_456.8), (f32::MIN, f32::MAX), (5.0, 5.0)] {
        let mut picture = draw(&[], &camera, &PLAIN);
        picture.legend(min, max);
        assert!(pixels().filter(|&(x, y)| picture.pixel(x, y) != WHITE).count() > 300);
    }
    let view = View { eye: EYE, target: [0.0; 3], up: [0.0, 0.0, 1.0], lens: SQUARE };
    for (width_px, height_px) in [(1, 1), (60, 5), (5, 60), (70, 70)] {
        let camera = Camera::new(&view, Size { width_px, height_px }, &frame()).unwrap();
        draw(&[], &camera, &PLAIN).legend(-123_456.0, 987_654.0);
    }
}

#[test]
fn a_wish_to_stop_ends_it() {
    let stopped = render(&Few(walls(10, 1.0)), &ahead(EYE, SQUARE), &PLAIN, MEMORY, &mut |_| false);
    assert!(matches!(stopped, Err(RenderError::Stopped)));
}

#[test]
fn what_is_clipped_is_not_there() {
    let at = |x: f32| disc([x, 100.0, 1000.0], TOWARDS, 5.0, RED);
    let all = Few(vec![at(950.0), at(1000.0), at(1050.0)]);
    let corners = [[1040.0, 0.0, 0.0], [960.0, 200.0, 2000.0]];
    let clipped = Clipped::new(Box::new(all), corners, &frame());
    let mut drawn = Vec::new();
    clipped.read(0..3, &mut drawn).unwrap();
    assert_eq!(drawn, [at(1000.0)]);
    assert_eq!(clipped.n_splats(), 3);
}

#[test]
fn an_orthographic_picture_from_a_place_holds_what_it_should() {
    let splats = [[900.0, 50.0, 950.0], [1010.0, 60.0, 1300.0]]
        .map(|c| disc(c, [0.0; 3], 1.0, RED))
        .to_vec();
    let up = [0.0, 0.0, 1.0];
    let view = View { eye: EYE, target: [1000.0, 9.0, 1000.0], up, lens: SQUARE };
    let width = view.fitting_width(&Few(splats), SIZE, &frame()).unwrap();
    // 300 up from the middle, 4:3, and the margin.
    let expected = 2.0 * 300.0 * 4.0 / 3.0 / 0.92;
    assert!((width / expected - 1.0).abs() < 1e-6, "{width} {expected}");
}
