//! Rows N01…N92 of the numeric catalogue and the tests that hold them, as a table that is made
//! from the sources: a row without a test, a test of a row that is not there or a table that is
//! not up to date fails. INSTA_UPDATE=always writes `numeric_catalogue.md` anew.
#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// What each row puts in, from N01 on.
const ROWS: [&str; 92] = [
    "points a millimetre apart at coordinates of a map projection",
    "coordinates as far out as the Earth's centre and the Sun",
    "a PLY, whose coordinates have no integer grid",
    "two LAS tiles of different scale and offset, one with all of 32 bits",
    "header bounds that are too small, NaN or the wrong way round",
    "more copies of one point than a leaf may hold",
    "all points in one place",
    "no point; one point",
    "points on a line",
    "a sheet that lies in a face of cells",
    "a point on the far face of the root",
    "points on the faces of cells, at coordinates of a map projection",
    "points of one Morton code, in any order",
    "coordinates that are NaN or infinite",
    "negative zeros",
    "coordinates that are all denormal",
    "coordinates of about 1e300",
    "a slab 10 km wide and 1 mm thick",
    "a crowd in a cubic millimetre, and as many points all over a cubic kilometre",
    "more points than 32 bits count",
    "copies of a point far out: the mean",
    "points that hug the faces of their cell",
    "a leaf of a single point",
    "a leaf of copies",
    "collinear points without normals",
    "noise of a millimetre at coordinates of a map projection: the covariance",
    "both faces of a thin wall in one leaf",
    "normals from very short to very long",
    "normals that are zero, NaN or infinite",
    "normals of random sign",
    "a leaf of foliage, normals in all directions",
    "the points of a leaf in any order",
    "normals of the file that contradict the points",
    "a leaf of two points far apart",
    "a disc parallel to the segment",
    "a disc whose plane holds the segment",
    "a disc that is all but parallel to the segment",
    "a crossing all but at an end of the segment",
    "a crossing on the rim of a disc",
    "the discs of the ends themselves",
    "neighbours of an end on a flat wall, at a grazing angle",
    "a surfel seen edge-on",
    "a segment of no length",
    "a verdict asked from either end",
    "a scan moved by whole steps of its grid",
    "a scan scaled by a power of two",
    "the 48 symmetries of the cube",
    "a wider disc, one more occluder, a lower K",
    "an occluder that is met twice",
    "a leaf against an inner node",
    "a pair of nodes of which all children are partial",
    "a leaf of level 2 against one of level 20",
    "two points of one leaf; a root that is a leaf",
    "each reason to reject an occluder",
    "leaf verdicts against all pairs of their points",
    "random segments through cells",
    "a segment along the diagonal of cells",
    "a segment in a face of cells",
    "a segment along an edge of cells and through a corner",
    "a segment along an axis, in the face of a box",
    "a segment all but along an axis",
    "an end on the boundary of cells",
    "empty cells that are skipped in an adaptive tree",
    "a segment across the whole grid",
    "boxes that a test in floats might miss",
    "two elements that come ever nearer",
    "near elements on the inside of a sphere",
    "two elements of one plane",
    "unit squares at a right angle and face to face",
    "coaxial discs up to 10⁶ radii apart",
    "what two elements exchange, asked from either end",
    "rows of a closed room and of an open scene",
    "elements back to back, and such with two sides",
    "rows and albedos with which light would grow",
    "a closed furnace",
    "surfaces that reflect nothing",
    "surfaces that absorb nothing",
    "albedos below 0, above 1 and NaN; colours of 8 bits in fields of 16",
    "no emitter, one emitter",
    "an emitter that nobody sees",
    "emitters 10¹² : 1",
    "the sum of two emissions",
    "where all light goes",
    "boxes of any size and the highest orders",
    "nodes ever nearer to each other",
    "a scene far from the origin",
    "expansions that fall below zero",
    "any number of threads",
    "a residual that is NaN",
    "processors with and without wide instructions",
    "areas of zero",
    "black patches and tolerances",
];

/// Lists the Rust files of a folder and those in it, in the order of their names.
fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    let mut entries: Vec<PathBuf> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    entries.sort();
    for path in entries {
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

/// Gives the rows that the name of a test begins with, `n16_n17_…` or `v7_n49_…`.
fn rows_of(name: &str) -> Vec<usize> {
    let is_number = |word: &&str| {
        let (kind, digits) = word.split_at(word.len().min(1));
        ["d", "f", "n", "v"].contains(&kind) && digits.parse::<usize>().is_ok() || *word == "to"
    };
    let numbers = name.split('_').take_while(is_number).filter_map(|word| word.strip_prefix('n'));
    numbers.map(|digits| digits.parse().unwrap()).collect()
}

/// Gives the names of all tests of a file that are not ignored.
fn tests_of(text: &str) -> impl Iterator<Item = &str> {
    let lines = text.lines().map(str::trim);
    let after_mark = lines.clone().zip(lines.skip(1)).filter(|(mark, _)| *mark == "#[test]");
    after_mark.filter_map(|(_, line)| line.strip_prefix("fn ")?.split('(').next())
}

/// Gives the tests of every row, as (file, name).
fn tests_by_row(root: &Path) -> BTreeMap<usize, Vec<(String, String)>> {
    let mut files = Vec::new();
    for folder in ["src", "pipeline", "tests"] {
        sources(&root.join(folder), &mut files);
    }
    let mut tests = BTreeMap::<usize, Vec<_>>::new();
    for path in files {
        let file = path.strip_prefix(root).unwrap().to_str().unwrap().to_owned();
        for name in tests_of(&std::fs::read_to_string(&path).unwrap()) {
            for row in rows_of(name) {
                tests.entry(row).or_default().push((file.clone(), name.to_owned()));
            }
        }
    }
    tests
}

fn table(tests: &BTreeMap<usize, Vec<(String, String)>>) -> String {
    let mut text = "# The numeric catalogue: which test holds which row\n\n\
        Made from the sources by `tests/numeric_catalogue.rs`; `INSTA_UPDATE=always cargo test \
        --test numeric_catalogue`\nwrites it anew. What a row asks stands in its tests.\n\n\
        | row | what is put in | tests |\n|---|---|---|\n"
        .to_owned();
    for (row, input) in (1..).zip(ROWS) {
        let each = tests[&row].iter().map(|(file, name)| format!("`{file}` `{name}`"));
        let each = each.collect::<Vec<_>>().join("<br>");
        writeln!(text, "| N{row:02} | {input} | {each} |").unwrap();
    }
    text
}

#[test]
fn every_row_has_a_test_and_the_table_says_which() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let tests = tests_by_row(root);
    let missing: Vec<usize> = (1..=ROWS.len()).filter(|row| !tests.contains_key(row)).collect();
    assert!(missing.is_empty(), "no test of these rows: {missing:?}");
    for (row, tests) in &tests {
        assert!((1..=ROWS.len()).contains(row), "there is no row N{row:02}: {tests:?}");
    }
    let (path, expected) = (root.join("tests/numeric_catalogue.md"), table(&tests));
    if std::env::var_os("INSTA_UPDATE").is_some_and(|v| v == "always") {
        std::fs::write(&path, &expected).unwrap();
    }
    let found = std::fs::read_to_string(&path).unwrap_or_default();
    assert_eq!(found, expected, "write it anew: INSTA_UPDATE=always");
}

#[test]
fn names_tell_their_rows() {
    assert_eq!(rows_of("n07_n16_any"), [7, 16]);
    assert_eq!(rows_of("v7_n56_n63_pairs_n12"), [56, 63]);
    assert_eq!(rows_of("v1_to_v5_n50_n51_maps"), [50, 51]);
    assert_eq!(rows_of("d2_n45_a_las"), [45]);
    for name in ["d2_a_las", "nearest_n07", "n_up", "f59_cut"] {
        assert!(rows_of(name).is_empty(), "{name}");
    }
    let text = "#[test]\nfn n01_a() {\n#[test]\n#[ignore]\nfn n02_b() {\nfn n03_c() {\n";
    assert_eq!(tests_of(text).collect::<Vec<_>>(), ["n01_a"]);
}
