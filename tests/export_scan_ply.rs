//! Exports onto a PLY's own file: every line and row of it comes back, with fields that are those
//! of the points of the octree.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;
mod export_common;

use std::fmt::Write as _;
use std::process::Command;

use cli_common::{Bench, data};
use export_common::{FIELD_BYTES, FIELDS, fields_of, scan};
use fastrand::Rng;
use pvmap::geometry::Positions;

/// How numbers of a PLY are written.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Form {
    Text,
    Little,
    Big,
}

impl Form {
    fn word(self) -> &'static str {
        match self {
            Form::Text => "ascii",
            Form::Little => "binary_little_endian",
            Form::Big => "binary_big_endian",
        }
    }

    /// Appends a number, given as text and as bytes with the least first.
    fn put(self, out: &mut Vec<u8>, text: &str, bytes: &[u8]) {
        match self {
            Form::Text if out.is_empty() => out.extend_from_slice(text.as_bytes()),
            Form::Text => out.extend_from_slice(format!(" {text}").as_bytes()),
            Form::Little => out.extend_from_slice(bytes),
            Form::Big => out.extend(bytes.iter().rev()),
        }
    }
}

/// A PLY in pieces.
struct Pieces {
    /// Up to the properties of a vertex and their end; what follows in the header.
    head: [String; 2],
    before: Vec<u8>,
    rows: Vec<Vec<u8>>,
    after: Vec<u8>,
    end: &'static str,
}

impl Pieces {
    /// Makes a floor and a ceiling with a plate between them, with properties and elements that
    /// nobody asks for. Every hundredth vertex has no place where `has_holes`.
    fn new(form: Form, has_list: bool, has_holes: bool, end: &'static str) -> Pieces {
        let rng = &mut Rng::with_seed(61);
        let Positions::Double(places) = scan(20, 61).positions else { panic!("other positions") };
        let n = places.len();
        let mut head = format!("ply\nformat {} 1.0\ncomment who\n", form.word());
        write!(head, "obj_info what\nelement camera 2\nproperty float tilt\nelement vertex {n}\n")
            .unwrap();
        head += "property short Dip_(°)\nproperty double x\nproperty double y\nproperty double z\n";
        head += if has_list { "property list uchar ushort echoes\n" } else { "" };
        head += "property float visible_from\nproperty uint id\n";
        let tail = "element face 3\nproperty list uchar int vertex_indices\nend_header\n";
        // Comments in between stay where they are: the fields stand before the next element.
        let head = [head + "comment why\n", tail.to_owned()];
        let mut rows = Vec::new();
        for (i, place) in places.into_iter().enumerate() {
            let mut row = Vec::new();
            let dip = rng.i16(..);
            form.put(&mut row, &dip.to_string(), &dip.to_le_bytes());
            for v in place {
                let v = if has_holes && i % 100 == 50 { f64::NAN } else { v };
                form.put(&mut row, &format!("{v:?}"), &v.to_le_bytes());
            }
            if has_list {
                let n = rng.u8(..5);
                form.put(&mut row, &n.to_string(), &[n]);
                for _ in 0..n {
                    let v = rng.u16(..);
                    form.put(&mut row, &v.to_string(), &v.to_le_bytes());
                }
            }
            let v = rng.i32(-1000..1000) as f32 / 8.0;
            form.put(&mut row, &format!("{v:.4}"), &v.to_le_bytes());
            form.put(&mut row, &i.to_string(), &(i as u32).to_le_bytes());
            rows.push(row);
        }
        let (mut before, mut after) = (Vec::new(), Vec::new());
        let line = |out: &mut Vec<u8>, row: Vec<u8>| {
            out.extend_from_slice(&row);
            out.extend_from_slice(if form == Form::Text { end.as_bytes() } else { b"" });
        };
        for tilt in [0.5f32, 0.25] {
            let mut row = Vec::new();
            form.put(&mut row, &tilt.to_string(), &tilt.to_le_bytes());
            line(&mut before, row);
        }
        for i in 0..3i32 {
            let mut row = Vec::new();
            form.put(&mut row, "3", &[3]);
            (i..i + 3).for_each(|v| form.put(&mut row, &v.to_string(), &v.to_le_bytes()));
            line(&mut after, row);
        }
        let head = head.map(|h| h.replace('\n', end));
        Pieces { head, before, rows, after, end }
    }

    /// Joins them, with `lines` behind the format, properties and what each row has behind it.
    fn joined(&self, form: Form, lines: &str, properties: &str, tails: &[Vec<u8>]) -> Vec<u8> {
        let [lines, properties] = [lines, properties].map(|l| l.replace('\n', self.end));
        let start = format!("ply\nformat {} 1.0\n", form.word()).replace('\n', self.end);
        let rest = self.head[0].strip_prefix(&start).unwrap();
        let head = format!("{start}{lines}{rest}{properties}{}", self.head[1]);
        let mut out = [head.as_bytes(), &self.before].concat();
        for (i, row) in self.rows.iter().enumerate() {
            out.extend_from_slice(row);
            out.extend_from_slice(tails.get(i).map_or(&[][..], Vec::as_slice));
            out.extend_from_slice(if form == Form::Text { self.end.as_bytes() } else { b"" });
        }
        [out, self.after.clone()].concat()
    }
}

/// Gives what stands behind the rows of a scan, whose points have `fields`.
fn tails(form: Form, fields: &[[i64; 6]], has_holes: bool) -> Vec<Vec<u8>> {
    let mut fields = fields.iter();
    let n = fields.len() + if has_holes { fields.len() / 99 } else { 0 };
    let tail = |i: usize| {
        let hole = has_holes && i % 100 == 50;
        let values = if hole { &[0; 6] } else { fields.next().unwrap() };
        // A number behind others.
        let mut out = if form == Form::Text { vec![b'.'] } else { Vec::new() };
        for (value, n_bytes) in values.iter().zip([1, 4, 4, 1, 1, 1]) {
            form.put(&mut out, &value.to_string(), &value.to_le_bytes()[..n_bytes]);
        }
        out.split_off(usize::from(form == Form::Text))
    };
    (0..n).map(tail).collect()
}

const LINES: &str = "comment pvmap export
comment visible_from_2: 1 if seen from 0.1,0.1,-1
comment sees_count: other surfels its surfel sees
comment leaf: its surfel
comment level: level of its surfel's cell
comment bin: bin of its surfel's normal
comment visible_from_3: 1 if seen from -0.9,0.9,1
";
const PROPERTIES: &str = "property uchar visible_from_2
property uint sees_count
property uint leaf
property uchar level
property char bin
property uchar visible_from_3
";

#[test]
fn every_line_and_row_of_a_ply_comes_back() {
    for (form, has_list, has_holes, end) in [
        (Form::Text, false, false, "\n"),
        (Form::Text, true, true, "\r\n"),
        (Form::Little, false, true, "\n"),
        (Form::Little, true, false, "\n"),
        (Form::Big, true, true, "\n"),
        (Form::Big, false, false, "\n"),
    ] {
        let bench = Bench::new();
        let pieces = Pieces::new(form, has_list, has_holes, end);
        bench.write("a.ply", pieces.joined(form, "", "", &[]));
        bench.line("ingest a.ply -o a.octree --skip-invalid").ok();
        bench.line("build a.octree --max-level 4 -o a.vmap").ok();
        bench.line(&format!("export a.vmap --points plain.ply {FIELDS}")).ok();
        let fields = fields_of(&bench.path("plain.ply"));
        let line = format!("export a.vmap --points out.ply --scan a.ply {FIELDS}");
        let run = bench.line(&line).ok();
        if has_holes {
            run.warns(&["out.ply", "12 records have no place"]);
        }
        let tails = tails(form, &fields, has_holes);
        let expected = pieces.joined(form, LINES, PROPERTIES, &tails);
        assert!(bench.read("out.ply") == expected, "{form:?}, {has_list}, {has_holes}");
        // It knows its own file again, and what it made is a scan.
        bench.line(&line).ok();
        bench.line("export a.vmap --points next.ply --scan out.ply").ok();
        assert!(bench.read("next.ply") == expected, "{form:?} once more");
        python(&bench, has_list);
    }
    assert_eq!(FIELD_BYTES, 12);
}

/// Opens what was written with plyfile, or says that it cannot.
fn python(bench: &Bench, has_list: bool) {
    let run = |script: &str| {
        let mut python = Command::new("python3");
        python.current_dir(bench.path("")).args(["-c", script]).output()
    };
    if !run("import numpy, plyfile").is_ok_and(|o| o.status.success()) {
        eprintln!("skipped: no python3 with numpy and plyfile");
        return;
    }
    // It reads no names but those of ASCII, and no header with carriage returns.
    let made = ["a.ply", "out.ply"].map(|name| {
        let bytes = bench.read(name);
        let end = bytes.windows(11).position(|w| w == b"end_header\n" || w == b"end_header\r");
        let end = end.unwrap() + 11;
        let head = String::from_utf8_lossy(&bytes[..end]).replace("°", "o").replace('\r', "");
        let head = if head.ends_with('\n') { head } else { head + "\n" };
        let body = if bytes[end - 1] == b'\r' { end + 1 } else { end };
        [head.as_bytes(), &bytes[body..]].concat()
    });
    bench.write("was.ply", &made[0]);
    bench.write("is.ply", &made[1]);
    let lists = if has_list { "['echoes']" } else { "[]" };
    let script = format!(
        "
import numpy as np
from plyfile import PlyData
a, b = PlyData.read('was.ply'), PlyData.read('is.ply')
assert [e.name for e in a] == [e.name for e in b] == ['camera', 'vertex', 'face']
assert a.obj_info == b.obj_info and set(a.comments) <= set(b.comments)
names = [p.name for p in a['vertex'].properties]
added = 'visible_from_2 sees_count leaf level bin visible_from_3'.split()
assert [p.name for p in b['vertex'].properties] == names + added
for name in names:
    x, y = a['vertex'][name], b['vertex'][name]
    assert x.dtype == y.dtype
    if name in {lists}:
        assert all((p == q).all() for p, q in zip(x, y))
    else:
        assert x.tobytes() == y.tobytes(), name
assert 0 < b['vertex']['visible_from_2'].mean() < 1 and b['vertex']['sees_count'].max() > 1
faces = [f['face']['vertex_indices'] for f in (a, b)]
assert all((p == q).all() for p, q in zip(*faces)) and len(faces[1]) == 3
"
    );
    let output = run(&script).unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn another_ply_and_one_that_was_cut_are_refused() {
    let bench = Bench::new();
    let pieces = Pieces::new(Form::Little, false, false, "\n");
    let whole = pieces.joined(Form::Little, "", "", &[]);
    bench.write("a.ply", &whole);
    bench.line("ingest a.ply").ok();
    bench.line("build a.octree --max-level 4").ok();
    let other = Pieces::new(Form::Little, false, true, "\n");
    bench.write("b.ply", other.joined(Form::Little, "", "", &[]));
    let line = "export a.vmap --points out.ply --scan";
    let words = ["b.ply", "not the scan", "record 50 is at NaN"];
    bench.line(&format!("{line} b.ply")).fails(65, &words);
    bench.write("cut.ply", &whole[..whole.len() - 10_000]);
    bench.line("ingest cut.ply -o cut.octree --lenient").ok();
    bench.line("build cut.octree --max-level 4").ok();
    bench
        .line("export cut.vmap --points out.ply --scan cut.ply")
        .fails(65, &["cut.ply", "cut short", "without --scan"]);
    assert!(!bench.names().contains(&"out.ply".to_owned()));
}

/// Gives a text PLY of a small floor, with these lines before its format.
fn text(aside: &str) -> String {
    let head = format!("ply\n{aside}format ascii 1.0\nelement vertex 30\n");
    let rows: String = (0..30).map(|i| format!("{} {} 0\n", i % 6, i / 6)).collect();
    head + "property float x\nproperty float y\nproperty float z\nend_header\n" + &rows
}

/// Gives what an export of the numbers of the records makes of [`text`].
fn numbered(aside: &str) -> String {
    let mut expected = text(aside)
        .replace(" 1.0\n", " 1.0\ncomment pvmap export\ncomment record: its number in its scan\n")
        .replace("end_header", "property uint record\nend_header");
    for i in 0..30 {
        let row = format!("\n{} {} 0\n", i % 6, i / 6);
        expected = expected.replacen(&row, &format!("{} {i}\n", row.trim_end()), 1);
    }
    expected
}

#[test]
fn lines_of_a_ply_come_back_however_they_end() {
    let asides = ["", "comment a leading one\n", "obj_info what\ncomment two\n"];
    for (aside, end) in asides.iter().flat_map(|a| ["\n", "\r", "\r\n"].map(|end| (*a, end))) {
        let bench = Bench::new();
        bench.write("a.ply", text(aside).replace('\n', end));
        bench.line("ingest a.ply --normals none").ok();
        bench.line("build a.octree --max-level 3").ok();
        // The second time it knows its own file.
        for _ in 0..2 {
            bench.line("export a.vmap --points out.ply --scan a.ply --field record").ok();
            let found = String::from_utf8(bench.read("out.ply")).unwrap();
            assert_eq!(found, numbered(aside).replace('\n', end), "{aside:?}, {end:?}");
        }
    }
}

#[test]
fn blank_lines_and_blanks_of_a_ply_are_left_out_as_help_says() {
    let bench = Bench::new();
    let [head, rows] =
        text("").split("end_header\n").map(str::to_owned).collect::<Vec<_>>().try_into().unwrap();
    let head = head.replacen("ply\n", "ply  \n", 1);
    bench.write("a.ply", format!("{head}end_header\n{}", rows.replace('\n', "  \n\n")));
    bench.line("ingest a.ply --normals none").ok();
    bench.line("build a.octree --max-level 3").ok();
    bench.line("export a.vmap --points out.ply --scan a.ply --field record").ok();
    // What is behind the last vertex is kept.
    let expected = numbered("").replacen("ply\n", "ply  \n", 1) + "\n";
    assert_eq!(String::from_utf8(bench.read("out.ply")).unwrap(), expected);
    let help = bench.line("export --help").ok().stdout;
    assert!(help.contains("blank\nlines among the vertices and blanks behind them"));
}

#[test]
fn the_normals_of_a_scan_stay_its_own_beside_those_of_the_map() {
    let bench = Bench::new();
    let rows: String =
        (0..30).map(|i| format!("{} {} 0 0 0.6 0.8 1 0 0\n", i % 6, i / 6)).collect();
    let names = ["x", "y", "z", "nx", "ny", "nz", "normal_x", "normal_y", "normal_z"];
    bench.write("a.ply", cli_common::ply_header(30, &names) + &rows);
    let (source, batch) = export_common::read(&bench.path("a.ply"));
    assert!(source.info().columns.normal);
    assert_eq!(batch.normal, Some(vec![[0.0, 0.6, 0.8]; 30]));
}

#[test]
fn a_real_ply_keeps_its_properties() {
    let Some(scans) = data("scans") else { return };
    let name = "lion_takanawa_normals_342k.ply";
    let bench = Bench::new();
    std::os::unix::fs::symlink(scans.join(name), bench.path("a.ply")).unwrap();
    bench.line("ingest a.ply").ok();
    bench.line("build a.octree --max-level 4").ok();
    bench.line("export a.vmap --points out.ply --scan a.ply --field leaf").ok();
    let (was, is) = (export_common::read(&bench.path("a.ply")), bench.read("out.ply"));
    let (source, batch) = export_common::read(&bench.path("out.ply"));
    assert!(batch == was.1 && source.info().columns == was.0.info().columns);
    let n_points = batch.len() as u64;
    let added = was.0.info().len_bytes + 4 * n_points;
    // The header has three lines more.
    assert!((added..added + 200).contains(&(is.len() as u64)));
}
