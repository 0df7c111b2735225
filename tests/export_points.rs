//! Exports onto the user's own points: what was scanned comes back as it was and where it was, with
//! fields that are what `Map::pair` says one by one.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod export_common;

use std::io::Write;
use std::process::Command;

use cli_common::Bench;
use export_common::{
    ALL_COLUMNS, NO_CONTENT, build, expected, export, fields_of, read, scan, world, write_las,
    write_ply,
};
use pvmap::geometry::{PointBatch, Positions};
use pvmap::scan::{ColorRange, Columns, Crs, LasContent, PlyColumns};

#[test]
fn las_of_any_format_comes_back_as_it_was_with_fields_that_are_right() {
    // A directory of one key: the model, number 1024, is projected.
    let keys = [1u16, 1, 0, 1, 1024, 0, 1, 1].iter().flat_map(|v| v.to_le_bytes()).collect();
    let tiff = Some(Crs::GeoTiff { keys, doubles: Vec::new(), texts: b"here|".to_vec() });
    let wkt = Some(Crs::Wkt(b"PROJCS[\"somewhere\"]".to_vec()));
    for (format, name, color, gps_time, crs) in [
        (0, "a.las", false, false, &tiff),
        (1, "a.laz", false, true, &tiff),
        (2, "a.las", true, false, &tiff),
        (3, "a.las", true, true, &tiff),
        (3, "a.laz", true, true, &tiff),
        (6, "a.las", false, true, &None),
        (7, "a.las", true, true, &wkt),
        (7, "a.laz", true, true, &wkt),
    ] {
        let bench = Bench::new();
        let content = LasContent { color, gps_time, crs: crs.clone(), ..NO_CONTENT };
        write_las(&bench.path(name), &scan(30, format), [500_000.0, -3.0, 0.0], &content);
        let (source, batch) = read(&bench.path(name));
        assert!(source.info().format.ends_with(&format!("format {format}")));
        bench.line(&format!("ingest {name} -o a.octree")).ok();
        bench.line("build a.octree --max-level 4 -o a.vmap").ok();
        for output in ["out.las", "out.laz"] {
            export(&bench, output);
            let (found_source, found) = read(&bench.path(output));
            assert!(found == batch, "{format}, {name} to {output}");
            assert_eq!(found_source.info().kind, source.info().kind);
            assert_eq!(found_source.info().columns, source.info().columns);
            assert_eq!(found_source.info().bounds, source.info().bounds);
            assert_eq!(&found_source.info().crs, crs);
            let found_format = &found_source.info().format;
            assert!(found_format.ends_with(&format!("format {format}")), "{found_format}");
            // Bit 0 of the global encoding: times since 1980, which those of no week must be.
            assert_eq!(bench.read(output)[6] & 1, u8::from(gps_time));
        }
    }
}

#[test]
fn the_fields_are_what_pairs_say() {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), &scan(40, 5), [0.0; 3], &LasContent::default());
    build(&bench, &["a.las"]);
    for config in ["depth8", "paper"] {
        bench.line(&format!("build a.octree --config {config} --max-level 4 -o a.vmap")).ok();
        let expected = expected(&bench);
        for output in ["out.las", "out.ply"] {
            export(&bench, output);
            assert!(fields_of(&bench.path(output)) == expected, "{output}, {config}");
        }
    }
}

#[test]
fn ply_comes_back_as_it_was() {
    for double in [false, true] {
        let bench = Bench::new();
        write_ply(&bench.path("a.ply"), &scan(30, 6), PlyColumns { double, ..ALL_COLUMNS });
        build(&bench, &["a.ply"]);
        let (source, batch) = read(&bench.path("a.ply"));
        export(&bench, "out.ply");
        let (found_source, found) = read(&bench.path("out.ply"));
        // Colours have 8 bits there.
        let cut = |c: &[u16; 3]| c.map(|v| v >> 8);
        let color = batch.color.as_ref().map(|c| c.iter().map(cut).collect());
        assert!(found == PointBatch { color, ..batch.clone() });
        let color = Some(ColorRange::Eight);
        let columns = Columns { color, ..source.info().columns };
        assert_eq!(found_source.info().columns, columns);
        assert!(fields_of(&bench.path("out.ply")) == expected(&bench));
        // In a LAS they are on a lattice of a hundred-millionth, and the rest is as it was.
        let line = "export a.vmap --octree a.octree --points out.laz";
        bench.line(line).ok().warns(&["rounded", ".ply"]);
        let (_, found) = read(&bench.path("out.laz"));
        let places = [&batch, &found].map(|b| world(&b.positions));
        let far = |(a, b): (&[f64; 3], &[f64; 3])| (0..3).any(|i| (a[i] - b[i]).abs() > 1e-8);
        assert!(!places[0].iter().zip(&places[1]).any(far));
        assert!(found.color == batch.color && found.classification == batch.classification);
        assert!(found.gps_time == batch.gps_time && found.normal == batch.normal);
    }
}

#[test]
fn several_scans_follow_each_other() {
    let bench = Bench::new();
    let content = LasContent::default();
    let (first, mut second) = (scan(30, 7), scan(20, 8));
    write_las(&bench.path("a.las"), &first, [0.0; 3], &content);
    // Another offset of the same lattice, and 8-bit colours.
    second.color.iter_mut().flatten().flatten().for_each(|c| *c %= 256);
    write_las(&bench.path("b.laz"), &second, [2.0, 0.0, -1.0], &content);
    build(&bench, &["b.laz", "a.las"]);
    let expected = expected(&bench);
    for output in ["out.las", "out.ply"] {
        export(&bench, output);
        assert!(fields_of(&bench.path(output)) == expected, "{output}");
    }
    let (b, a) = (read(&bench.path("b.laz")).1, read(&bench.path("a.las")).1);
    let (_, found) = read(&bench.path("out.las"));
    let [Positions::Lattice(b_at), Positions::Lattice(a_at), Positions::Lattice(at)] =
        [&b.positions, &a.positions, &found.positions]
    else {
        panic!("no lattice");
    };
    // The lattice is that of the first: the other's places are 2000 and 1000 steps away in it.
    let moved = a_at.iter().map(|x| [x[0] - 2000, x[1], x[2] + 1000]);
    assert!(b_at.iter().copied().chain(moved).eq(at.iter().copied()));
    let times = b.gps_time.iter().chain(&a.gps_time).flatten();
    assert!(times.eq(found.gps_time.iter().flatten()));
    // Full brightness is one thing in one file.
    let bright = b.color.iter().flatten().map(|c| c.map(|v| v * 257));
    assert!(bright.chain(a.color.clone().unwrap()).eq(found.color.clone().unwrap()));

    // On different lattices, and with a PLY among them.
    write_las(&bench.path("b.laz"), &second, [0.0004, 0.0, 0.0], &content);
    write_ply(&bench.path("c.ply"), &scan(10, 9), ALL_COLUMNS);
    for (scans, is_near) in [(&["a.las", "b.laz"][..], 5.1e-4), (&["b.laz", "c.ply"], 1e-8)] {
        build(&bench, scans);
        for output in ["out.ply", "out.las"] {
            export(&bench, output);
            assert!(fields_of(&bench.path(output)) == self::expected(&bench), "{scans:?}");
        }
        let places = ["out.ply", "out.las"].map(|name| {
            let (source, batch) = read(&bench.path(name));
            match (source.info().kind, batch.positions) {
                (pvmap::scan::PositionKind::Lattice { scale, offset }, Positions::Lattice(v)) => {
                    let world =
                        |x: &[i32; 3]| [0, 1, 2].map(|i| f64::from(x[i]) * scale[i] + offset[i]);
                    v.iter().map(world).collect()
                }
                (_, positions) => world(&positions),
            }
        });
        let far = |(a, b): (&[f64; 3], &[f64; 3])| (0..3).any(|i| (a[i] - b[i]).abs() > is_near);
        assert!(!places[0].iter().zip(&places[1]).any(far), "{scans:?}");
    }
}

/// Runs a script, or says that it cannot where what a test prints is shown whatever comes of it.
fn python(bench: &Bench, module: &str, probe: &str, script: &str) {
    let run = |script: &str| {
        let mut python = Command::new("python3");
        python.current_dir(bench.path("")).args(["-c", script]).output()
    };
    if !run(&format!("import numpy, {module}\n{probe}")).is_ok_and(|o| o.status.success()) {
        let line = format!("skipped: no python3 with numpy and {module} that can do it\n");
        let _ = std::fs::File::options()
            .append(true)
            .open("/dev/stderr")
            .and_then(|mut stderr| stderr.write_all(line.as_bytes()));
        return;
    }
    let output = run(script).unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn laspy_opens_what_is_written_with_fields_and_order_intact() {
    let bench = Bench::new();
    write_las(&bench.path("a.las"), &scan(40, 15), [7.0; 3], &LasContent::default());
    bench.line("ingest a.las").ok();
    bench.line("build a.octree --max-level 4").ok();
    let fields = "--field visible-from=0.1,0.1,-1 --field visible-from=0,0,1 --field sees-count \
                  --field leaf --field level --field bin";
    for output in ["out.las", "out.laz", "out.ply"] {
        bench.line(&format!("export a.vmap --octree a.octree --points {output} {fields}")).ok();
    }
    let names = "visible_from visible_from_2 sees_count leaf level bin";
    python(
        &bench,
        "laspy",
        // Reading LAZ takes another package.
        "assert laspy.LazBackend.detect_available()",
        &format!(
            "
import laspy, numpy as np
a = laspy.read('a.las')
lists = []
for name in ['out.las', 'out.laz']:
    b = laspy.read(name)
    assert (a.header.scales == b.header.scales).all()
    assert (a.header.offsets == b.header.offsets).all()
    for d in 'X Y Z intensity classification gps_time red green blue nx ny nz'.split():
        assert (np.array(a[d]) == np.array(b[d])).all(), (name, d)
    assert list(b.point_format.extra_dimension_names) == 'nx ny nz {names}'.split()
    info = {{d.name: d for d in b.point_format.extra_dimensions}}
    assert info['visible_from'].description.startswith('1 if seen from 0.1,0.1,-1')
    lists.append([np.array(b[n]) for n in '{names}'.split()])
    kinds = [str(x.dtype) for x in lists[-1]]
    assert kinds == 'uint8 uint8 uint32 uint32 uint8 int8'.split(), kinds
    assert 0 < lists[-1][0].mean() < 1 and lists[-1][2].max() > 0
assert all((x == y).all() for x, y in zip(*lists))
"
        ),
    );
    python(
        &bench,
        "plyfile",
        "",
        &format!(
            "
import numpy as np
from plyfile import PlyData
v = PlyData.read('out.ply')['vertex']
names = [p.name for p in v.properties]
assert names[-6:] == '{names}'.split(), names
raw = open('a.las', 'rb').read()
start, n = int.from_bytes(raw[96:100], 'little'), int.from_bytes(raw[105:107], 'little')
rows = np.frombuffer(raw, np.uint8, offset=start, count=len(v.data) * n).reshape(-1, n)
x = rows[:, :12].copy().view(np.int32)
for i, d in enumerate('xyz'):
    assert np.abs(x[:, i] * 0.001 + 7.0 - v[d]).max() < 1e-9, d
color = rows[:, 30:36].copy().view(np.uint16)
assert v['red'].dtype == np.uint8
assert (np.stack([v['red'], v['green'], v['blue']], 1) == color >> 8).all()
assert v['visible_from'].dtype == np.uint8 and 0 < v['visible_from'].mean() < 1
assert v['bin'].dtype == np.int8 and v['sees_count'].dtype == np.uint32
"
        ),
    );
}
