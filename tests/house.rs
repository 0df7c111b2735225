//! The house is in order: the table of rooms in `pipeline/README.md` is what `cargo metadata` says,
//! rows of the catalogue have tests, files and lines are of a size that is read at a glance.

#![allow(clippy::unwrap_used)] // A panic is how a test fails.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

/// The rooms of the table: name to imports.
fn table() -> BTreeMap<String, BTreeSet<String>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("pipeline/README.md");
    let text = std::fs::read_to_string(path).unwrap();
    let rows = text.lines().filter(|l| l.starts_with("| ") && !l.starts_with("| room"));
    rows.map(|row| {
        let cells: Vec<&str> = row.trim_matches('|').split('|').map(str::trim).collect();
        let imports = cells[2].split(',').map(str::trim).filter(|i| *i != "–");
        (cells[0].to_owned(), imports.map(str::to_owned).collect())
    })
    .collect()
}

/// The rooms of the workspace: name to the rooms it depends on outside tests.
fn metadata() -> BTreeMap<String, BTreeSet<String>> {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--no-deps", "--offline", "--format-version", "1"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let metadata: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let room = |name: &serde_json::Value| Some(name.as_str()?.strip_prefix("pvmap-")?.to_owned());
    let packages = metadata["packages"].as_array().unwrap();
    packages
        .iter()
        .filter_map(|package| {
            let dependencies = package["dependencies"].as_array().unwrap();
            let imports = dependencies.iter().filter(|d| d["kind"].is_null());
            Some((room(&package["name"])?, imports.filter_map(|d| room(&d["name"])).collect()))
        })
        .collect()
}

#[test]
fn every_room_imports_what_its_row_says() {
    assert_eq!(table(), metadata());
}

#[test]
fn no_room_is_called_common_core_or_util() {
    for name in ["common", "core", "util"] {
        assert!(!metadata().contains_key(name), "{name}");
    }
}

/// The names of all tests of a folder's files.
fn test_names(folder: &Path) -> Vec<String> {
    let files = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let sources = files.filter(|p| p.extension().is_some_and(|e| e == "rs"));
    let name_of = |line: &str| Some(line.strip_prefix("fn ")?.split('(').next()?.to_owned());
    let names_of = |path| {
        let text = std::fs::read_to_string(path).unwrap();
        let after_mark =
            text.lines().zip(text.lines().skip(1)).filter(|(mark, _)| *mark == "#[test]");
        after_mark.filter_map(|(_, line)| name_of(line)).collect::<Vec<_>>()
    };
    sources.flat_map(names_of).collect()
}

#[test]
fn every_row_of_the_catalogue_of_faults_has_a_named_test() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let names = [test_names(&root.join("tests")), test_names(&root.join("pipeline/scan/tests"))];
    let names = names.concat();
    // Why two have none stands in pipeline/README.md.
    for row in (1..=72).filter(|row| ![14, 41].contains(row)) {
        let number = format!("f{row:02}_");
        assert!(names.iter().any(|name| name.starts_with(&number)), "no test of row F{row}");
    }
}

/// The Rust files of a folder and those in it.
fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

#[test]
fn files_have_at_most_600_lines_of_at_most_100_characters() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut found = Vec::new();
    for folder in ["src", "pipeline", "tests", "benches"] {
        sources(&root.join(folder), &mut found);
    }
    for path in found {
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.lines().count() <= 600, "{}", path.display());
        for (line, number) in text.lines().zip(1..) {
            assert!(line.chars().count() <= 100, "{}:{number}", path.display());
        }
    }
}
