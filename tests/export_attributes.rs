//! What exports keep of the scans' attributes, and what they say where that is less.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod export_common;

use cli_common::{Bench, Run};
use export_common::{ALL_COLUMNS, EYE, NO_CONTENT, build, read, scan, write_las, write_ply};
use pvmap::geometry::{Intensity, PointBatch};
use pvmap::query::{Light, Located, Map, Place, Sight, Snap};
use pvmap::scan::{Crs, LasContent, PlyColumns};

fn points(bench: &Bench, output: &str, fields: &str) -> Run {
    bench.line(&format!("export a.vmap --octree a.octree --points {output} {fields}")).ok()
}

/// Gives the last `n` bytes of every record of a LAS.
fn tails<const N: usize>(bench: &Bench, output: &str) -> Vec<[u8; N]> {
    let bytes = bench.read(output);
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    let (start, stride) = (word(96), word(105) & 0xffff);
    let n_points = read(&bench.path(output)).1.len();
    let rows = bytes[start..].chunks_exact(stride).take(n_points);
    rows.map(|row| row[stride - N..].try_into().unwrap()).collect()
}

fn no_warning(run: &Run, word: &str) {
    let mut lines = run.stderr.lines().filter(|l| l.contains("warning"));
    assert!(!lines.any(|l| l.contains(word)), "{}", run.stderr);
}

#[test]
fn intensities_that_a_las_has_no_room_for_stay_beside_it() {
    for (low, high, is_whole) in
        [(0.0, 1.0, false), (-30.0, 3.0, true), (0.0, 1e6, true), (0.5, 9.0, false)]
    {
        let bench = Bench::new();
        let mut batch = scan(20, 31);
        let n = batch.len();
        let value = |i: usize| {
            let v = low + (high - low) * (i as f32 / (n - 1) as f32);
            if is_whole { v.round() } else { v }
        };
        let values: Vec<f32> = (0..n).map(value).collect();
        batch.intensity = Some(Intensity::F32(values.clone()));
        write_ply(&bench.path("a.ply"), &batch, ALL_COLUMNS);
        build(&bench, &["a.ply"]);
        let run = points(&bench, "out.las", "").warns(&["out.las", "intensity_f32", ".ply"]);
        assert!(run.stdout.contains("new fields: none"), "{}", run.stdout);
        let was: Vec<f32> =
            tails::<4>(&bench, "out.las").into_iter().map(f32::from_le_bytes).collect();
        assert!(was == values, "{low} to {high}");
        let Some(Intensity::U16(scaled)) = read(&bench.path("out.las")).1.intensity else {
            panic!("no intensities");
        };
        assert!(scaled.is_sorted() && *scaled.last().unwrap() == 65535, "{low} to {high}");
        assert!(scaled.len() == n && scaled[n / 2] > 20_000);
        // A PLY keeps them as they are.
        no_warning(&points(&bench, "out.ply", ""), "intensit");
        assert!(read(&bench.path("out.ply")).1.intensity == batch.intensity);
    }
    // Whole ones have room.
    let bench = Bench::new();
    write_ply(&bench.path("a.ply"), &scan(20, 32), ALL_COLUMNS);
    build(&bench, &["a.ply"]);
    no_warning(&points(&bench, "out.las", ""), "intensit");
    let (Some(Intensity::F32(was)), Some(Intensity::U16(found))) =
        (read(&bench.path("a.ply")).1.intensity, read(&bench.path("out.las")).1.intensity)
    else {
        panic!("other intensities");
    };
    assert!(was.into_iter().eq(found.into_iter().map(f32::from)));
}

#[test]
fn records_that_are_not_there_are_told_and_numbers_say_which_are() {
    let bench = Bench::new();
    let mut text = cli_common::ply_header(402, &["x", "y", "z"]);
    for i in 0..402 {
        let x = if i % 200 == 7 { f64::NAN } else { f64::from(i % 20) };
        text += &format!("{x} {} 0\n", i / 20);
    }
    bench.write("holes.ply", text);
    write_las(&bench.path("b.las"), &scan(10, 33), [0.0; 3], &NO_CONTENT);
    bench.line("ingest b.las holes.ply -o a.octree --skip-invalid").ok();
    bench.line("build a.octree --max-level 3 -o a.vmap").ok();
    let run = points(&bench, "out.las", "--field leaf");
    run.warns(&["out.las", "2 records of holes.ply", "--field record"]);
    let run = points(&bench, "out.las", "--field record --field source");
    no_warning(&run, "holes.ply have");
    let found: Vec<(u32, u32)> = tails::<8>(&bench, "out.las")
        .into_iter()
        .map(|b| {
            let word = |at: usize| u32::from_le_bytes(b[at..at + 4].try_into().unwrap());
            (word(4), word(0))
        })
        .collect();
    let first = (0..300).map(|i| (0, i));
    let second = (0..402).filter(|i| i % 200 != 7).map(|i| (1, i));
    assert!(first.chain(second).eq(found));
    // A file that was cut short, too.
    let whole = bench.read("b.las");
    bench.write("cut.las", &whole[..whole.len() - 1000]);
    bench.line("ingest cut.las -o a.octree --overwrite --lenient").ok();
    bench.line("build a.octree --max-level 3 -o a.vmap").ok();
    points(&bench, "out.las", "").warns(&["out.las", "cut off", "--field record"]);
}

#[test]
fn a_reference_system_is_kept_or_said_to_be_left_out() {
    let keys = |model: u16| {
        let keys = [1u16, 1, 0, 1, 1024, 0, 1, model].into_iter().flat_map(u16::to_le_bytes);
        Some(Crs::GeoTiff { keys: keys.collect(), doubles: Vec::new(), texts: Vec::new() })
    };
    let bench = Bench::new();
    let with = |crs| LasContent { crs, ..NO_CONTENT };
    write_las(&bench.path("a.las"), &scan(20, 34), [0.0; 3], &with(keys(1)));
    build(&bench, &["a.las"]);
    points(&bench, "out.ply", "").warns(&["out.ply", "reference system", ".laz"]);
    no_warning(&points(&bench, "out.las", ""), "reference");
    // Classes that its point formats have no room for, from another scan.
    let mut many = scan(20, 35);
    many.classification.iter_mut().flatten().for_each(|c| *c = 64);
    write_las(&bench.path("b.las"), &many, [0.0; 3], &NO_CONTENT);
    build(&bench, &["a.las", "b.las"]);
    points(&bench, "out.las", "").warns(&["out.las", "left out", "up to 64", "WKT"]);
    assert_eq!(read(&bench.path("out.las")).0.info().crs, None);
    assert!(read(&bench.path("out.las")).1.classification.unwrap().ends_with(&[64]));
    // Two systems: the first is kept, and it is said.
    write_las(&bench.path("b.las"), &scan(20, 36), [0.0; 3], &with(keys(3)));
    let line = "ingest a.las b.las -o a.octree --overwrite";
    bench.line(line).ok().warns(&["b.las", "reference system", "a.las"]);
    write_las(&bench.path("b.las"), &scan(20, 36), [0.0; 3], &with(keys(1)));
    no_warning(&bench.line(line).ok(), "reference");
    // Longer than a plain record can be.
    let text = format!("PROJCS[\"{}\"]", "somewhere".repeat(8000));
    let long = Some(Crs::Wkt(text.into_bytes()));
    write_las(&bench.path("a.las"), &scan(20, 37), [0.0; 3], &with(long.clone()));
    build(&bench, &["a.las"]);
    for output in ["out.las", "out.laz"] {
        points(&bench, output, "");
        let (source, found) = read(&bench.path(output));
        assert!(source.info().crs == long && source.info().warnings.is_empty());
        assert!(found == read(&bench.path("a.las")).1);
    }
}

#[test]
fn gps_times_count_from_where_the_scan_says() {
    let bench = Bench::new();
    let write = |name: &str, is_standard_gps_time: bool, scale: f64| {
        let mut batch = scan(20, 38);
        batch.gps_time.iter_mut().flatten().for_each(|t| *t *= scale);
        let content = LasContent { gps_time: true, is_standard_gps_time, ..NO_CONTENT };
        write_las(&bench.path(name), &batch, [0.0; 3], &content);
    };
    // Whatever the values look like.
    for (since_1980, scale) in [(true, 1e-9), (false, 1.0), (true, 1.0), (false, 1e-9)] {
        write("a.las", since_1980, scale);
        build(&bench, &["a.las"]);
        for output in ["out.las", "out.laz"] {
            no_warning(&points(&bench, output, ""), "GPS");
            assert_eq!(bench.read(output)[6] & 1, u8::from(since_1980), "{since_1980}, {scale}");
        }
    }
    write("b.las", true, 1.0);
    build(&bench, &["a.las", "b.las"]);
    points(&bench, "out.las", "").warns(&["out.las", "GPS times", "of a week"]);
    // A PLY does not say.
    write_ply(&bench.path("c.ply"), &scan(20, 39), ALL_COLUMNS);
    build(&bench, &["c.ply"]);
    points(&bench, "out.las", "");
    assert_eq!(bench.read("out.las")[6] & 1, 1);
}

#[test]
fn columns_that_only_some_scans_have_are_told() {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), &scan(20, 40), [0.0; 3], &LasContent::default());
    let bare = PlyColumns { normal: true, ..PlyColumns::default() };
    write_ply(&bench.path("b.ply"), &scan(10, 41), bare);
    build(&bench, &["a.las", "b.ply"]);
    for output in ["out.ply", "out.laz"] {
        let run = points(&bench, output, "");
        let told = |word: &str| run.stderr.matches(&format!("no {word} in b.ply")).count();
        assert_eq!(
            ["color", "intensity", "class", "gps time", "normal"].map(told),
            [1, 1, 1, 1, 0]
        );
        let (a, found) = (read(&bench.path("a.las")).1, read(&bench.path(output)).1);
        let color = found.color.unwrap();
        let cut = if output == "out.ply" { 8 } else { 0 };
        let a_color = a.color.unwrap().into_iter().map(|c| c.map(|v| v >> cut));
        assert!(a_color.eq(color[..1200].iter().copied()));
        assert!(color[1200..].iter().all(|c| *c == [0; 3]) && color.len() == 1500);
    }
    build(&bench, &["a.las"]);
    no_warning(&points(&bench, "out.las", ""), " in ");
}

#[test]
fn scans_of_the_other_point_formats_come_in() {
    // What this crate writes has formats 0 to 3, 6 and 7; 4, 5 and 8 to 10 have more behind.
    let longer = [(3, 5, 63), (1, 4, 57), (6, 9, 59), (7, 8, 38), (7, 10, 67)];
    for (format, other, record_bytes) in longer {
        let bench = Bench::new();
        let keys = [1u16, 1, 0, 1, 1024, 0, 1, 1].iter().flat_map(|v| v.to_le_bytes()).collect();
        let tiff = Crs::GeoTiff { keys, doubles: Vec::new(), texts: Vec::new() };
        let crs = (format < 6).then_some(tiff);
        let color = format == 3 || format == 7;
        let content = LasContent { color, gps_time: true, crs, ..NO_CONTENT };
        write_las(&bench.path("plain.las"), &scan(20, 42), [0.0; 3], &content);
        let batch = PointBatch { normal: None, ..read(&bench.path("plain.las")).1 };
        bench.write("a.las", widened(&bench.read("plain.las"), other, record_bytes));
        let (source, found) = read(&bench.path("a.las"));
        assert!(source.info().format.ends_with(&format!("format {other}")) && found == batch);
        bench.line("ingest a.las").ok();
        bench.line("build a.octree --max-level 4").ok();
        for output in ["out.las", "out.laz"] {
            points(&bench, output, "--field leaf");
            assert!(read(&bench.path(output)).1 == batch, "{other}");
        }
    }
}

/// Makes the records of a LAS longer: what is behind the columns of the old format goes.
fn widened(bytes: &[u8], format: u8, record_bytes: usize) -> Vec<u8> {
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    let (start, stride) = (word(96), word(105) & 0xffff);
    let kept = [20, 28, 26, 34, 0, 0, 30, 36][usize::from(bytes[104])];
    let mut out = bytes[..start].to_vec();
    out[104] = format;
    out[105..107].copy_from_slice(&(record_bytes as u16).to_le_bytes());
    for row in bytes[start..].chunks_exact(stride) {
        out.extend_from_slice(&row[..kept]);
        out.resize(out.len() + record_bytes - kept, 0);
    }
    out
}

#[test]
fn light_sides_and_normals_are_those_of_the_map() {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), &scan(30, 43), [0.0; 3], &NO_CONTENT);
    build(&bench, &["a.las"]);
    // Over the plate in the middle, and at the eye on the floor.
    let fields = "--field leaf --field normal --field lit=0.2,0.1,0.5 --field lit=0.1,0.1,-1 \
                  --field visible-from=0,0,0,0,0,1 --field visible-from=0,0,0,0,0,-1";
    let run = points(&bench, "out.las", fields);
    let names = "leaf, normal_x, normal_y, normal_z, lit, lit_2, visible_from, visible_from_2";
    assert!(run.stdout.contains(names), "{}", run.stdout);
    let bytes = bench.read("a.vmap");
    let map = Map::open(&bytes).unwrap();
    let at = |position, normal| map.locate(&Place { position, normal }, Snap::default()).unwrap();
    let sides = [1.0, -1.0].map(|z| at([0.0; 3], Some([0.0, 0.0, z])));
    let eye = at(EYE, None);
    for (name, place) in [("lit_2", &eye), ("visible_from", &sides[0])] {
        let line = format!("place     of {name}: surfel {}, {} away", place.surfel, place.distance);
        assert!(run.stdout.contains(&line), "no {line} in {}", run.stdout);
    }
    assert!(run.stdout.contains("place     of lit: in the air"), "{}", run.stdout);
    assert_ne!(sides[0].surfel, sides[1].surfel);
    let expected = |surfel: u32| {
        let node = map.view().surfel(surfel).unwrap().node;
        let here = Located { surfel, node, distance: 0.0 };
        let air = map.shadow(&here, &Light::Air([0.2, 0.1, 0.5])).unwrap();
        let sees = |other: &Located| u8::from(map.pair(other, &here).unwrap().visible);
        let lit = u8::from(air.reaches == Sight::All);
        [lit, sees(&eye), sees(&sides[0]), sees(&sides[1])]
    };
    let n_surfels = map.view().summary().n_surfels;
    let expected: Vec<[u8; 4]> = (0..n_surfels).map(expected).collect();
    for i in 0..4 {
        assert!((0..2).all(|v| expected.iter().any(|e| e[i] == v)), "some of both: {i}");
    }
    let normals = read(&bench.path("a.las")).1.normal.unwrap();
    for (row, normal) in tails::<20>(&bench, "out.las").iter().zip(normals) {
        let four = |at: usize| -> [u8; 4] { row[at..at + 4].try_into().unwrap() };
        assert_eq!(row[16..], expected[u32::from_le_bytes(four(0)) as usize]);
        assert_eq!([4, 8, 12].map(|at| f32::from_le_bytes(four(at))), normal);
    }
    // Where scans have no normals the map's have the names of theirs.
    bench.line("ingest a.las -o a.octree --overwrite --normals estimate").ok();
    bench.write("plain.ply", cli_common::room_ply(12).replace(" nx", " a").replace(" ny", " b"));
    bench.line("ingest plain.ply -o a.octree --overwrite --sensor 0,0,0").ok();
    bench.line("build a.octree --max-level 3 -o a.vmap").ok();
    for output in ["out.ply", "out.las"] {
        points(&bench, output, "--field normal");
        let found = read(&bench.path(output)).1.normal.unwrap();
        let expected = |i: usize| [0.0, 0.0, if i < 144 { 1.0 } else { -1.0 }];
        assert!(found.iter().enumerate().all(|(i, n)| *n == expected(i)), "{found:?}");
    }
}

#[test]
fn a_description_that_is_too_long_is_cut_at_a_comma_and_stands_whole_elsewhere() {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), &scan(20, 44), [0.0; 3], &NO_CONTENT);
    build(&bench, &["a.las"]);
    let whole = "1 if seen from 0.123456789,0.1987654321,-0.9123";
    points(&bench, "out.las", "--field visible-from=0.123456789,0.1987654321,-0.9123 --snap 1");
    let text = String::from_utf8_lossy(&bench.read("out.las")).into_owned();
    assert!(text.contains("\0\x001 if seen from 0.123456789\0"));
    assert!(text.contains("pvmap\0") && text.contains(&format!("visible_from: {whole}\n")));
    points(&bench, "short.las", "--field visible-from=0.1,0.1,-1");
    assert!(!String::from_utf8_lossy(&bench.read("short.las")).contains("visible_from: "));
}
