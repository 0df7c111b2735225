//! The table of rooms in `pipeline/README.md` is what `cargo metadata` says.

#![allow(clippy::unwrap_used)] // A panic is how a test fails.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
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
