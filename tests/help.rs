//! The help of every command, and what `info` prints, held against snapshots: a change of a word
//! is seen in review. INSTA_UPDATE=always writes them anew.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod cli_common;

use cli_common::{Bench, room};

/// Every page of help: its name, and what asks for it.
const PAGES: [(&str, &str); 20] = [
    ("pvmap", "--help"),
    ("ingest", "ingest --help"),
    ("build", "build --help"),
    ("query", "query --help"),
    ("query_pair", "query a.vmap pair --help"),
    ("query_pairs", "query a.vmap pairs --help"),
    ("query_visible_from", "query a.vmap visible-from --help"),
    ("query_sees_count", "query a.vmap sees-count --help"),
    ("query_region", "query a.vmap region --help"),
    ("query_ray", "query a.vmap ray --help"),
    ("query_shadow", "query a.vmap shadow --help"),
    ("info", "info --help"),
    ("verify", "verify --help"),
    ("export", "export --help"),
    ("light", "light --help"),
    ("render", "render --help"),
    ("scene", "scene --help"),
    ("accuracy", "accuracy --help"),
    ("tradeoff", "tradeoff --help"),
    ("demo", "demo --help"),
];

#[test]
fn help_is_as_it_was() {
    let bench = Bench::new();
    for (name, line) in PAGES {
        insta::assert_snapshot!(name, bench.line(line).ok().stdout);
    }
}

#[test]
fn help_fits_a_terminal_and_has_examples_units_and_defaults() {
    let bench = Bench::new();
    for (name, line) in PAGES {
        let page = bench.line(line).ok().stdout;
        for line in page.lines() {
            assert!(line.chars().count() <= 100, "{name}: {line}");
        }
        let (_, examples) = page.split_once("\nExamples:\n").unwrap_or_else(|| panic!("{name}"));
        let command = name.split('_').next().unwrap();
        let start =
            if name == "pvmap" { "  pvmap ".to_owned() } else { format!("  pvmap {command} ") };
        assert!(examples.contains(&start) || examples.contains(&start[1..]), "{name}: {examples}");
        assert!(page.contains("[default: auto]"), "{name}: defaults");
    }
    for command in [
        "ingest", "build", "query", "light", "render", "info", "verify", "export", "scene",
        "accuracy", "tradeoff", "demo",
    ] {
        assert!(bench.line("--help").ok().stdout.contains(&format!("\n  {command} ")));
        // The short form and the long one are the same page.
        let [short, long] = ["-h", "--help"].map(|h| bench.line(&format!("{command} {h}")).ok());
        assert_eq!(short.stdout, long.stdout);
    }
    for (name, unit) in [
        ("query_pair", "scan's units"),
        ("export", "grid steps"),
        ("render", "degrees"),
        ("scene", "metres"),
        ("ingest", "MiB"),
    ] {
        let (_, line) = PAGES.into_iter().find(|p| p.0 == name).unwrap();
        assert!(bench.line(line).ok().stdout.contains(unit), "{name}");
    }
    assert_eq!(
        bench.line("--version").ok().stdout,
        format!("pvmap {}\n", env!("CARGO_PKG_VERSION"))
    );
}

#[test]
fn info_is_as_it_was() {
    let bench = room();
    bench.line("build --config preview -o preview.vmap").ok();
    for (name, line) in [
        ("info_octree", "info room.octree"),
        ("info_octree_json", "info room.octree --json"),
        ("info_quality", "info room.octree --quality"),
        ("info_map", "info room.vmap"),
        ("info_map_json", "info room.vmap --json"),
        ("info_preview", "info preview.vmap"),
    ] {
        insta::assert_snapshot!(name, bench.line(line).ok().stdout);
    }
}
