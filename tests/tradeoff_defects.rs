//! What defects of a scan cost: generated scans that each have one thing wrong with them.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use cli_common::{Bench, Run, count_of_class, info};
use serde_json::Value;

fn json(run: &Run) -> Value {
    serde_json::from_str(&run.stdout).unwrap()
}

/// Gives what of an answer is the same from run to run: of every scan its name, points and pairs,
/// of every setting the counts.
fn counts(answer: &Value) -> Vec<String> {
    let keys = ["setting", "leaves", "links", "wrongly_visible", "wrongly_invisible"];
    let row = |row: &Value| keys.map(|key| row[key].to_string()).join(" ");
    let scan = |scan: &Value| {
        let head = ["scan", "points", "facing", "visible"].map(|key| scan[key].to_string());
        let rows = scan["settings"].as_array().unwrap().iter().map(row);
        head.into_iter().chain(rows).collect::<Vec<_>>().join(" ")
    };
    answer["scans"].as_array().unwrap().iter().map(scan).collect()
}

fn share(row: &Value, key: &str) -> f64 {
    row[key]["share"].as_f64().unwrap()
}

#[test]
fn each_defect_is_measured_by_itself() {
    let bench = Bench::new();
    let scene = "tradeoff packed --points 20k --pairs 8k --config depth8 --json";
    let line = format!(
        "{scene} --density 5k,20k,10k --noise 0,1mm,10cm --uneven 1,16 --holes 0,20% \
         --no-normals 100% --flip-normals 5%"
    );
    let answer = json(&bench.line(&line).ok());
    assert_eq!((&answer["judge"], &answer["pairs"]), (&"geometry".into(), &8000.into()));
    let scans = answer["scans"].as_array().unwrap();
    let names: Vec<_> = scans.iter().map(|s| s["scan"].as_str().unwrap()).collect();
    // What a plain scan has is no defect.
    assert_eq!(names[0], "as it is");
    assert_eq!(names[1..4], ["5000 points", "10 k points", "noise 1 mm"]);
    assert_eq!(names[4..6], ["noise 100 mm", "uneven 16"]);
    assert_eq!(names[6..], ["holes 20 %", "no normals 100 %", "flipped normals 5 %"]);
    let n_points: Vec<_> = scans.iter().map(|s| s["points"].as_u64().unwrap()).collect();
    assert_eq!(n_points[..5], [20_000, 5000, 10_000, 20_000, 20_000]);
    assert!(n_points[5].abs_diff(20_000) < 400 && n_points[6].abs_diff(16_000) < 400);
    let row = |i: usize| &scans[i]["settings"][0];
    // The scan as it is, is that of a sweep over settings.
    let plain = json(&bench.line(scene).ok());
    for key in ["leaves", "links", "map_bytes"] {
        assert_eq!(row(0)[key], plain["settings"][0][key], "{key}");
    }
    // A place on an edge may be another surface's for who knows its normal and place alone.
    let n = |value: &Value| value.as_u64().unwrap();
    assert!(n(&scans[0]["facing"]).abs_diff(n(&plain["facing"])) < 10);
    let wrong = |row: &Value| n(&row["error"]["n"]);
    assert!(wrong(row(0)).abs_diff(wrong(&plain["settings"][0])) < 10);
    // Truth is asked where the points truly are: none is left out, and as many face each other.
    for scan in [0, 3, 4, 7, 8].map(|i| &scans[i]) {
        assert!(n(&scan["facing"]).abs_diff(n(&scans[0]["facing"])) < 200, "{scan}");
    }
    // Fewer points are worse, and so is noise beyond the spacing; what is flipped faces nothing.
    assert!(share(row(1), "error") > 1.3 * share(row(0), "error"));
    assert!(share(row(4), "error") > 3.0 * share(row(0), "error"));
    assert!((share(row(3), "error") / share(row(0), "error") - 1.0).abs() < 0.2);
    assert!(share(row(8), "wrongly_invisible") > 0.05 + share(row(0), "wrongly_invisible"));
    // One sees through holes.
    assert!(share(row(6), "wrongly_visible") > 1.2 * share(row(0), "wrongly_visible"));
    assert_eq!(bench.names(), [""; 0], "maps and scans are temporary");
}

#[test]
fn the_same_seed_makes_the_same_scans_and_pairs() {
    let bench = Bench::new();
    let line = "tradeoff furnished --points 4k --pairs 2k --noise 1cm --holes 10% --uneven 9 \
                --flip-normals 2% --no-normals 5% --json --seed";
    let of = |seed: u32, threads: u32| {
        counts(&json(&bench.line(&format!("{line} {seed} --threads {threads}")).ok()))
    };
    let one = of(1, 1);
    assert_eq!(one.len(), 6);
    assert_eq!(one, of(1, 2));
    assert!(one.iter().zip(of(2, 2)).all(|(a, b)| *a != b));
}

#[test]
fn without_normals_of_its_own_a_scan_is_estimated() {
    let bench = Bench::new();
    let line = "tradeoff empty --points 4k --pairs 2k --json --config depth8";
    let exact = json(&bench.line(&format!("{line} --noise 1mm")).ok());
    let estimated = json(&bench.line(&format!("{line} --noise 1mm --estimate-normals")).ok());
    assert_ne!(counts(&exact)[0], counts(&estimated)[0]);
    // It is no defect by itself, but all scans have it.
    let alone = json(&bench.line(&format!("{line} --estimate-normals")).ok());
    assert_eq!(counts(&alone), counts(&estimated)[..1]);
}

#[test]
fn tables_and_the_plot_have_every_scan_and_setting() {
    let bench = Bench::new();
    let line = "tradeoff empty --points 3k --pairs 2k --density 1k,6k --noise 2mm,4mm \
                --holes 10% --csv t.csv --svg t.svg --cpu";
    let told = bench.line(line).ok().stdout;
    let csv = String::from_utf8(bench.read("t.csv")).unwrap();
    let mut reader = csv::Reader::from_reader(csv.as_bytes());
    let header = reader.headers().unwrap().clone();
    let rows: Vec<_> = reader.records().map(Result::unwrap).collect();
    let cell = |row: &csv::StringRecord, name: &str| {
        row[header.iter().position(|h| h == name).unwrap()].to_owned()
    };
    assert_eq!(rows.len(), 6 * 2);
    for (row, line) in rows.iter().zip(told.lines().skip(5)) {
        let [scan, setting] = ["scan", "setting"].map(|name| cell(row, name));
        assert!(line.starts_with(&scan) && line.contains(&format!(" {setting} ")), "{line}");
        assert!(
            line.contains(&cell(row, "points")) && line.contains(&cell(row, "links")),
            "{line}"
        );
        let error: f64 = cell(row, "error").parse().unwrap();
        assert!(line.contains(&format!(" {:.2} (", 100.0 * error)), "{line}");
    }
    let firsts: Vec<_> = rows.iter().map(|row| [cell(row, "defect"), cell(row, "value")]).collect();
    assert_eq!(firsts[0], ["", ""]);
    assert_eq!(firsts[2], ["points", "1000"]);
    assert_eq!(firsts[6], ["noise", "0.002"]);
    assert_eq!(firsts[10], ["holes", "0.1"]);
    // Of two settings: density has the scan as it is beside its two values, the others a dashed
    // line for it.
    let svg = String::from_utf8(bench.read("t.svg")).unwrap();
    assert_eq!(count_of_class(&svg, "scan"), 2 * (3 + 2 + 1));
    assert_eq!(count_of_class(&svg, "plain"), 2 * 2);
    assert_eq!(count_of_class(&svg, "frame"), 3);
    assert!(svg.contains("depth8, noise 4 mm: error "), "{svg}");
    assert!(told.contains(" CPU s ") && told.contains("where it was before the defect"), "{told}");
    // A table of its own is replaced.
    bench.line("tradeoff empty --points 1k --pairs 1k --noise 1mm --csv t.csv").ok();
}

#[test]
fn a_scan_with_defects_shows_them_to_info() {
    let bench = Bench::new();
    let defects = "--noise 5mm --no-normals 10% --flip-normals 4% --holes 15%";
    bench.line(&format!("scene empty --points 40k {defects} -o rough.ply")).ok();
    bench.line("ingest rough.ply").ok();
    let found = &info(&bench, "rough.octree --quality")["quality"];
    let number = |key: &str| found[key].as_f64().unwrap();
    assert!(bench.n_stored("rough.octree").abs_diff(34_000) < 200);
    assert!((number("thickness") / 0.005 - 1.0).abs() < 0.15, "{found}");
    // Of a normal that is missing the neighbors say the side.
    assert!((number("turned_percent") - 0.9 * 4.0).abs() < 0.6, "{found}");
    let octree = info(&bench, "rough.octree");
    let estimated = octree["normals"]["estimated"].as_f64().unwrap() / 34_000.0;
    assert!((estimated - 0.1).abs() < 0.01, "{octree}");
    // The same words make the same bytes.
    bench.line(&format!("scene empty --points 40k {defects} -o again.ply")).ok();
    assert_eq!(bench.read("rough.ply"), bench.read("again.ply"));
}

#[test]
fn holes_take_a_few_bytes_a_point() {
    let bench = Bench::new();
    let of = |defects: &str| {
        let line = format!("scene empty --points 2M {defects} -o a.ply --progress off");
        bench.line(&line).ok().anon_bytes
    };
    let (plain, with_holes) = (of(""), of("--holes 5%"));
    // As much to spare for what the system does not give back at once.
    let allowed = plain + 2 * 2_000_000 * 4;
    assert!(with_holes <= allowed, "{with_holes} bytes with holes, {plain} without");
}

#[test]
fn defects_that_cannot_be_are_refused_in_one_line() {
    let bench = Bench::new();
    bench.line("scene empty --points 1k -o a.ply").ok();
    for (line, words) in [
        ("tradeoff a.ply --noise 1mm", &["a.ply", "generated scene"][..]),
        ("tradeoff empty --noise 1mm --want error=1%", &["--want", "settings"]),
        ("tradeoff empty --noise 1mile", &["1mile", "3mm"]),
        ("tradeoff empty --holes 99%", &["95 %"]),
        ("tradeoff empty --flip-normals 5", &["5%"]),
        ("tradeoff empty --uneven 0.1", &["0.1", "ratio"]),
        ("tradeoff empty --density 0", &["--density"]),
        ("scene empty --noise=-1mm -o b.ply", &["-1mm"]),
        ("scene empty --noise 1e300 -o b.ply", &["1e300", "0 to 1000000 m"]),
        ("scene empty --holes 1e300 -o b.ply", &["1e300", "0 to 100 %"]),
        ("scene empty --points 1e300 -o b.ply", &["1e300", "0 to 1000000G"]),
        ("tradeoff empty --uneven 1e300", &["1e300", "1 to 1000000"]),
        ("tradeoff empty --no-normals 1e300", &["1e300", "0 to 100 %"]),
        ("tradeoff empty --density 1e300", &["1e300", "0 to 1000000G"]),
    ] {
        bench.line(&format!("{line} --progress off")).fails(2, words);
    }
}
