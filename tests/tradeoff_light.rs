//! What light costs: the maps of a sweep, lit in several ways and held against what is known.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use cli_common::{Bench, Run, count_of_class, interrupted, noise_ply};
use serde_json::Value;

const GREY: &str = include_str!("reference/grey.toml");
const SCAN: &str = include_str!("reference/scan.toml");
const PLACES: &str = include_str!("reference/furnished-grey.csv");
const COLORED_PLACES: &str = include_str!("reference/furnished-scan.csv");

/// A folder with the lamp of the Cornell room and what a path tracer says of it.
fn lamp() -> Bench {
    let bench = Bench::new();
    bench.write("lamp.toml", GREY);
    bench.write("places.csv", PLACES);
    bench
}

fn json(run: &Run) -> Value {
    serde_json::from_str(&run.stdout).unwrap()
}

fn rows(answer: &Value) -> &Vec<Value> {
    answer["rows"].as_array().unwrap()
}

fn number(row: &Value, key: &str) -> f64 {
    row[key].as_f64().unwrap_or_else(|| panic!("no {key} in {row}"))
}

#[test]
fn light_is_held_against_irradiance_of_places() {
    let bench = lamp();
    let line = "tradeoff furnished --points 40k --lights lamp.toml --irradiance places.csv --json";
    let answer = json(&bench.line(&format!("{line} --max-level 5 --leaf-capacity 100,25")).ok());
    assert_eq!((&answer["judge"], &answer["places"]), (&"irradiance".into(), &256.into()));
    let all = rows(&answer);
    let lights: Vec<_> = all.iter().map(|row| row["light"].as_str().unwrap()).collect();
    let ways = ["order 1", "order 2", "order 3", "order 4", "order 5", "direct"];
    let errors = ["error 5 %", "error 1 %", "error 0.2 %"];
    assert_eq!(lights, [&ways[..], &errors, &ways, &errors].concat());
    for row in all {
        assert_eq!((number(row, "judged"), number(row, "left_out")), (256.0, 0.0));
        let [mean, bias, largest] =
            ["mean_error", "bias", "largest_error"].map(|key| number(row, key));
        assert!(bias.abs() <= mean && mean < largest, "{row}");
        assert!(number(row, "light_seconds") > 0.0);
        assert!(number(row, "light_peak_rss_anon_bytes") > 1e6);
        assert_eq!(row["outcome"], "lit");
    }
    let error = |i: usize| number(&all[i], "mean_error");
    // A path tracer is as far off as the surfels are coarse; multipoles of order 1 are worse.
    assert!(error(5) < 0.06 && error(14) < 0.04, "{answer}");
    assert!(error(0) > 1.3 * error(5), "{answer}");
    assert!((error(4) / error(5) - 1.0).abs() < 0.02, "{answer}");
    assert_eq!(number(&all[5], "order"), 0.0);
    assert_eq!(number(&all[5], "operator_error"), 0.0);
    assert_eq!(number(&all[2], "order"), 3.0);
    assert_eq!(bench.names(), ["lamp.toml", "places.csv"], "maps and lights are temporary");
}

#[test]
fn the_figures_are_those_of_the_light_of_pvmap_light() {
    use pvmap::query::{Map, Place, Snap};
    use pvmap::vmap::LightView;
    let bench = lamp();
    bench.line("scene furnished --points 20k -o a.ply").ok();
    bench.line("ingest a.ply").ok();
    let line = "tradeoff a.octree --lights lamp.toml --irradiance places.csv --config depth8 \
                --order 2 --json";
    let answer = json(&bench.line(line).ok());
    bench.line("build a.octree").ok();
    bench.line("light a.vmap --lights lamp.toml --order 2").ok();
    let (map_bytes, light_bytes) = (bench.read("a.vmap"), bench.read("a.light"));
    let map = Map::open(&map_bytes).unwrap().solid();
    let light = LightView::open(&light_bytes).unwrap();
    let paths = [bench.path("a.light"), bench.path("a.vmap")];
    let lit = pvmap::LitMap::read((&paths[0], &light), (&paths[1], map.view())).unwrap();
    let mut reader = csv::ReaderBuilder::new().comment(Some(b'#')).from_reader(PLACES.as_bytes());
    let offs = reader.records().map(|row| {
        let cells: Vec<f64> = row.unwrap().iter().map(|cell| cell.parse().unwrap()).collect();
        let position = [cells[0], cells[1], cells[2]];
        let normal = [cells[3], cells[4], cells[5]].map(|v| v as f32);
        let place = Place { position, normal: Some(normal) };
        let surfel = map.locate(&place, Snap::FourHalfSpacings).unwrap().surfel;
        let at = map.view().frame().frame.grid_of_query(position).unwrap();
        lit.irradiance(at, normal, surfel)[0] / cells[7] - 1.0
    });
    let offs: Vec<f64> = offs.collect();
    let mean = |of: fn(f64) -> f64| offs.iter().map(|&v| of(v)).sum::<f64>() / 256.0;
    let row = &rows(&answer)[0];
    let near = |key: &str, value: f64| {
        let found = number(row, key);
        assert!((found - value).abs() < 1e-9, "{key}: {found}, {value}");
    };
    near("mean_error", mean(f64::abs));
    near("bias", mean(|v| v));
    near("largest_error", offs.iter().fold(0.0, |most: f64, v| most.max(v.abs())));
}

#[test]
fn without_places_the_light_pair_by_pair_is_a_reference() {
    let bench = lamp();
    let line = "tradeoff furnished --points 20k --lights lamp.toml --max-level 6 --order 1,3 \
                --direct --error 5%,1e-5 --csv t.csv --svg t.svg";
    let answer = json(&bench.line(&format!("{line} --json")).ok());
    assert_eq!((&answer["judge"], &answer["places"]), (&"reference".into(), &Value::Null));
    let all = rows(&answer);
    let lights: Vec<_> = all.iter().map(|row| row["light"].as_str().unwrap()).collect();
    assert_eq!(lights, ["order 1", "order 3", "direct", "error 5 %", "error 0.001 %"]);
    let error = |i: usize| number(&all[i], "mean_error");
    // What is asked for is kept, and by order and direct 1 %.
    assert!(error(2) <= 0.01 && error(3) <= 0.05 && error(4) <= 1e-5, "{answer}");
    assert!(error(0) > error(1) && error(1) <= 0.02, "{answer}");
    assert!(all.iter().all(|row| row["judged"] == row["leaves"]), "{answer}");
    let told = bench.line(line).ok().stdout;
    for said in [told, String::from_utf8(bench.read("t.svg")).unwrap()] {
        assert!(said.contains("reference (not truth): the light of the same map"), "{said}");
    }
    let csv = String::from_utf8(bench.read("t.csv")).unwrap();
    assert_eq!(csv.matches(",reference,").count(), 5, "{csv}");
}

#[test]
fn tables_and_the_plot_have_every_setting_and_way() {
    let bench = lamp();
    let line = "tradeoff furnished --points 20k --lights lamp.toml --irradiance places.csv --cpu \
                --max-level 5 --leaf-capacity 25,8 --profile patch,oriented --order 1,3 --direct \
                --csv t.csv --svg t.svg --want error=100%";
    let told = bench.line(line).ok().stdout;
    let csv = String::from_utf8(bench.read("t.csv")).unwrap();
    let mut reader = csv::Reader::from_reader(csv.as_bytes());
    let header = reader.headers().unwrap().clone();
    let all: Vec<_> = reader.records().map(Result::unwrap).collect();
    assert_eq!(all.len(), 4 * 3);
    let cell = |row: &csv::StringRecord, name: &str| {
        row[header.iter().position(|h| h == name).unwrap()].to_owned()
    };
    for (row, line) in all.iter().zip(told.lines().skip(5)) {
        let number = |name: &str| cell(row, name).parse::<f64>().unwrap();
        let star = if cell(row, "on_front") == "true" { '*' } else { ' ' };
        let begins = format!("{star} {} ", cell(row, "setting"));
        assert!(line.starts_with(&begins), "{line}");
        let both = number("build_cpu_seconds") + number("light_cpu_seconds");
        for word in [
            format!(" {} ", cell(row, "light")),
            format!(" {both:.2} "),
            format!(" {} ", cell(row, "links")),
            format!(" {:.2} ", 100.0 * number("mean_error")),
            format!(" {:.2} ", 100.0 * number("largest_error")),
        ] {
            assert!(line.contains(&word), "no {word:?} in: {line}");
        }
        // None is beaten by a figure of both.
        let figures = |row: &csv::StringRecord| {
            let read = |name: &str| cell(row, name).parse::<f64>().unwrap();
            (read("build_cpu_seconds") + read("light_cpu_seconds"), read("mean_error"))
        };
        let own = figures(row);
        let is_beaten = all.iter().map(figures).any(|(seconds, error)| {
            seconds <= own.0 + 1e-9 && error <= own.1 && (seconds + 1e-9 < own.0 || error < own.1)
        });
        assert_eq!(cell(row, "on_front") == "true", !is_beaten, "{line}");
    }
    assert!(told.contains(" CPU s "), "{told}");
    assert!(told.contains("irradiance of 256 places of places.csv"), "{told}");
    let last = told.lines().last().unwrap();
    assert!(last.starts_with("recommended for error ≤ 100 %: "), "{last}");
    assert!(last.contains(" s for map and light; error "), "{last}");
    // Two panels, each with a mark a light, and what is recommended in one.
    let svg = String::from_utf8(bench.read("t.svg")).unwrap();
    assert_eq!(count_of_class(&svg, "light"), 2 * 12);
    assert_eq!(count_of_class(&svg, "frame"), 2);
    assert_eq!(count_of_class(&svg, "chosen"), 1);
    assert!(svg.contains("level 5, capacity 8, direct: light "), "{svg}");
    // A table of its own is replaced.
    bench.line(&line.replace("--order 1,3 --direct", "--order 1")).ok();
}

#[test]
fn what_is_wanted_is_recommended() {
    let bench = lamp();
    let line = "tradeoff furnished --points 20k --lights lamp.toml --irradiance places.csv \
                --max-level 5 --leaf-capacity 100,25 --order 1,4";
    let last = |want: &str| {
        let told = bench.line(&format!("{line} --want {want}")).ok().stdout;
        told.lines().last().unwrap().to_owned()
    };
    let told = last("error=0.01%");
    let begins = "no light is within error ≤ 0.01 %; level 5, capacity 25, order 4 comes nearest: ";
    assert!(told.starts_with(begins), "{told}");
    let told = last("time=1h");
    let begins = "recommended for time ≤ 3600 s: level 5, capacity 25, order 4: error ";
    assert!(told.starts_with(begins), "{told}");
    let told = last("time=0s");
    assert!(told.starts_with("no light is within time ≤ 0 s; level 5"), "{told}");
    let answer = json(&bench.line(&format!("{line} --want time=1h --json")).ok());
    let found = &answer["recommended"];
    assert_eq!((&found["light"], &found["is_met"]), (&"order 4".into(), &true.into()));
    assert_eq!(found["setting"], "level 5, capacity 25");
}

#[test]
fn places_on_no_surface_are_counted() {
    let bench = lamp();
    let outside = "2.75,2.75,2.75,0,0,1,0,1,1,1,0\n9,9,9,0,0,1,0,1,1,1,0\n";
    bench.write("more.csv", format!("{PLACES}{outside}"));
    let line = "tradeoff furnished --points 20k --lights lamp.toml --max-level 5 --order 2 --json";
    let of = |table: &str| {
        let answer = json(&bench.line(&format!("{line} --irradiance {table}")).ok());
        let row = &rows(&answer)[0];
        ["judged", "left_out", "mean_error"].map(|key| number(row, key))
    };
    let [all, more] = ["places.csv", "more.csv"].map(of);
    assert_eq!([more[0], more[1]], [256.0, 2.0]);
    assert_eq!(all[2].to_bits(), more[2].to_bits());
    // In other units none is on a surface.
    bench.write("far.csv", format!("x,y,z,nx,ny,nz,irradiance\n{}", "99,99,99,0,0,1,1\n"));
    let line = line.replace("--json", "--irradiance far.csv --progress off");
    bench.line(&line).fails(65, &["far.csv", "none of its 1 places", "units"]);
}

#[test]
fn colours_count_by_themselves_and_a_grey_column_for_all() {
    let bench = lamp();
    bench.write("scan.toml", SCAN);
    bench.write("colored.csv", COLORED_PLACES);
    let line = "tradeoff furnished --points 20k --max-level 5 --order 3 --json";
    let of = |lights: &str, table: &str| {
        let line = format!("{line} --lights {lights} --irradiance {table}");
        number(&rows(&json(&bench.line(&line).ok()))[0], "mean_error")
    };
    let colored = of("scan.toml", "colored.csv");
    assert!(colored < 0.15, "{colored}");
    // Light of the grey room is as red by the green wall as elsewhere, and brighter.
    let by_grey = of("lamp.toml", "colored.csv");
    assert!(by_grey > 3.0 * colored, "{by_grey} {colored}");
    // Where only the mean of the three is known, what one has too much another may lack.
    let means = COLORED_PLACES.lines().filter(|line| !line.starts_with('#')).skip(1).map(|line| {
        let cells: Vec<&str> = line.split(',').collect();
        let sum: f64 = cells[7..10].iter().map(|cell| cell.parse::<f64>().unwrap()).sum();
        format!("{},{}\n", cells[..6].join(","), sum / 3.0)
    });
    let means: String = means.collect();
    bench.write("means.csv", format!("x,y,z,nx,ny,nz,irradiance\n{means}"));
    let of_means = of("scan.toml", "means.csv");
    assert!(0.5 * colored < of_means && of_means < colored, "{of_means} {colored}");
    // Columns in any order, by any case, and a name of PDAL's.
    let mut reader = csv::ReaderBuilder::new().comment(Some(b'#')).from_reader(PLACES.as_bytes());
    let mut grey = "Irradiance,//X,y,Z,nx,NY,nz,note\n".to_owned();
    for row in reader.records().map(Result::unwrap) {
        let [x, y, z, nx, ny, nz] = [0, 1, 2, 3, 4, 5].map(|i| row[i].to_owned());
        // The length of a normal says nothing.
        let nz = if nz == "1" { "2".to_owned() } else { nz };
        grey += &format!("{}, {x},{y},{z},{nx},{ny},{nz},\"a, b\"\n# {x}\n", &row[7]);
    }
    bench.write("grey.csv", grey);
    let [named, plain] = ["grey.csv", "places.csv"].map(|table| of("lamp.toml", table));
    assert!((named - plain).abs() < 1e-12, "{named} {plain}");
}

#[test]
fn what_cannot_be_lit_is_told() {
    let bench = lamp();
    // No surfel of a coarse map is within the lamp.
    let line = "tradeoff furnished --points 20k --lights lamp.toml --irradiance places.csv \
                --max-level 5,7,2 --leaf-capacity 25 --order 1,2";
    let run = bench.line(&format!("{line} --csv t.csv --svg t.svg")).ok();
    let row = run.stdout.lines().find(|l| l.contains("not lit: ")).unwrap();
    assert!(row.starts_with("  level 2") && row.contains("glow 1 selects no surfel"), "{row}");
    let csv = String::from_utf8(bench.read("t.csv")).unwrap();
    assert_eq!(csv.matches(",refused,,,").count(), 2, "{csv}");
    let svg = String::from_utf8(bench.read("t.svg")).unwrap();
    assert!(svg.contains("level 2, capacity 25, order 1: not lit"), "{svg}");
    // Maps of one tree are lit once.
    let line =
        line.replace("--max-level 5,7,2 --leaf-capacity 25", "--max-level 7,9 --leaf-capacity 100");
    let answer = json(&bench.line(&format!("{line} --json")).ok());
    let outcomes: Vec<_> =
        rows(&answer).iter().map(|row| row["outcome"].as_str().unwrap()).collect();
    assert_eq!(outcomes, ["lit", "lit", "same"]);
    assert_eq!(rows(&answer)[2]["why_not"], "map as level 7, capacity 100");
    assert_eq!(rows(&answer)[2]["light"], Value::Null);
}

#[test]
fn a_light_that_takes_too_long_is_stopped() {
    let bench = lamp();
    // Its map takes a second, a hundred thousand surfels pair by pair some minutes.
    let line = "tradeoff empty --points 400k --lights lamp.toml --leaf-capacity 4 \
                --max-level 8 --opening-angle 1 --limit 6";
    let run = bench.line(&format!("{line} --irradiance places.csv --direct --progress off")).ok();
    assert!(run.stdout.contains("direct       stopped at 6 s"), "{}", run.stdout);
    let run = bench.line(&format!("{line} --order 1 --want time=1h --progress off")).ok();
    assert!(run.stdout.contains("no reference: stopped at 6 s"), "{}", run.stdout);
    assert!(run.stdout.ends_with("nothing to recommend for time ≤ 3600 s: nothing was lit\n"));
}

#[test]
fn exit_130_a_stopped_sweep_tells_what_it_knows() {
    let bench = Bench::new();
    bench.write("a.ply", noise_ply(100_000));
    bench.write("sky.toml", "[albedo]\nfrom = 0.5\n[sky]\nradiance = 1\n");
    bench.line("ingest a.ply").ok();
    let line = "tradeoff a.octree --lights sky.toml --leaf-capacity 100000,50 --order 1 \
                --csv t.csv --svg t.svg --progress plain";
    let run = interrupted(&bench, line, "2 of 2").exits(130);
    assert!(run.stdout.contains("* capacity 100000 order 1 "), "{}", run.stdout);
    assert!(!run.stdout.contains("depth8"), "{}", run.stdout);
    assert_eq!(bench.names(), ["a.octree", "a.ply", "sky.toml", "temporary"]);
    assert_eq!(std::fs::read_dir(bench.path("temporary")).unwrap().count(), 0);
}

#[test]
fn what_cannot_be_asked_is_refused_in_one_line() {
    let bench = lamp();
    bench.write("broken.toml", "[albedo]\nfrom = 7\n");
    let head = "x,y,z,nx,ny,nz,irradiance\n";
    for (name, text) in [
        ("none.csv", head.to_owned()),
        ("empty.csv", String::new()),
        ("column.csv", "# a\nx,y,z,nx,ny,irradiance\n1,2,3,0,1,1\n".to_owned()),
        ("dark.csv", format!("{head}1,2,0,0,0,1,4\n\n# dark\n1,2,3,0,0,1,0\n")),
        ("less.csv", format!("{head}1,2,3,0,0,1,-1\n")),
        ("nan.csv", format!("{head}1,2,3,0,0,1,nan\n")),
        ("word.csv", format!("# of mine\n{head}1,2,3,0,up,1,1\n")),
        ("short.csv", format!("{head}1,2,3,0,0\n")),
        ("normal.csv", format!("{head}1,2,3,0,0,0,1\n")),
        ("twice.csv", format!("{head}1,2,3,0,0,1,1\n1,2,4,0,0,1,1\n1,2,3,0,0,1,2\n")),
        ("both.csv", "x,y,z,nx,ny,nz,irradiance,red,green,blue\n1,2,3,0,0,1,1,1,1,1\n".to_owned()),
        ("named.csv", "x,y,z,nx,ny,nz,red,red,green,blue\n1,2,3,0,0,1,1,1,1,1\n".to_owned()),
    ] {
        bench.write(name, text);
    }
    let scene = "tradeoff empty --points 1k";
    for (line, code, words) in [
        ("--lights lamp.toml --defects", 2, &["--defects", "--lights"][..]),
        ("--lights lamp.toml --noise 1mm", 2, &["pairs of points", "--lights"]),
        ("--lights lamp.toml --pairs 1k", 2, &["--pairs", "--lights"]),
        ("--lights lamp.toml --segment", 2, &["--segment", "--lights"]),
        ("--lights lamp.toml --truth a.ply", 2, &["--truth", "--lights"]),
        ("--irradiance places.csv", 2, &["--lights"]),
        ("--order 2", 2, &["--lights"]),
        ("--direct", 2, &["--lights"]),
        ("--error 1%", 2, &["--lights"]),
        ("--lights lamp.toml --order 8", 2, &["--order", "8"]),
        ("--lights lamp.toml --error 1e-7", 2, &["1e-7", "--direct"]),
        ("--lights lamp.toml --error 100%", 2, &["100%"]),
        ("--lights gone.toml", 66, &["gone.toml"]),
        ("--lights broken.toml", 78, &["broken.toml:2:"]),
        ("--lights lamp.toml --irradiance gone.csv", 66, &["gone.csv"]),
        ("--lights lamp.toml --csv lamp.toml --overwrite", 2, &["lamp.toml", "input"]),
        (
            "--lights lamp.toml --irradiance places.csv --svg places.csv --overwrite",
            2,
            &["places.csv", "input"],
        ),
    ] {
        bench.line(&format!("{scene} {line} --progress off")).fails(code, words);
    }
    for (table, words) in [
        ("none.csv", &["no places"][..]),
        ("empty.csv", &["no column irradiance"]),
        ("column.csv", &["no column nz"]),
        ("dark.csv", &["line 5", "is 0", "above 0"]),
        ("less.csv", &["line 2", "is -1"]),
        ("nan.csv", &["line 2", "irradiance is NaN"]),
        ("word.csv", &["line 3", "ny is \"up\""]),
        ("short.csv", &["line 2", "nz is \"\""]),
        ("normal.csv", &["line 2", "0,0,0", "no direction"]),
        ("twice.csv", &["line 4", "line 2", "another irradiance"]),
        ("both.csv", &["columns irradiance and red, green, blue"]),
        ("named.csv", &["column red stands twice"]),
    ] {
        let line = format!("{scene} --lights lamp.toml --irradiance {table} --progress off");
        bench.line(&line).fails(65, &[&[table][..], words].concat());
    }
}
