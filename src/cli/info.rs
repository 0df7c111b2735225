//! `pvmap info`: what is in an artifact.

use std::io::{self, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use pvmap::Error;
use pvmap::geometry::Frame;
use pvmap::vmap::container::kind_of;
use pvmap::vmap::frame::{CrsKind, FrameRecord};
use pvmap::vmap::{FormatError, Kind, MapView, OctreeView};
use serde_json::{Value, json};

use super::build::fewer_links;
use super::{Outcome, map_file, mib, print_json};

/// Show what is in an octree or a map.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  pvmap info grotto.octree\n  pvmap info grotto.vmap --json")]
pub(super) struct Args {
    /// A .vmap file or an .octree folder.
    file: PathBuf,
    /// As one JSON object.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Outcome {
    let (path, bytes) = map_file(&args.file)?;
    let described = match kind_of(&bytes) {
        Some(Kind::Octree) => OctreeView::open(&bytes).and_then(|v| octree(&v)),
        _ => MapView::open(&bytes).and_then(|v| map(&v)),
    };
    let mut value = described.map_err(|e| Error::artifact(&path, e))?;
    value["bytes"] = json!(bytes.len());
    if args.json {
        print_json(&value)?;
    } else {
        print(&value, &mut io::stdout().lock())?;
    }
    Ok(ExitCode::SUCCESS)
}

fn octree(view: &OctreeView<'_>) -> Result<Value, FormatError> {
    let s = view.summary();
    let columns: Vec<&str> = view.schema().columns().iter().map(|c| c.name).collect();
    let mut sources = Vec::new();
    for source in view.sources() {
        sources.push(json!({
            "name": view.source_name(source)?,
            "format": word(source.format, &["", "LAS", "LAZ", "PLY"]),
            "points": source.n_stored,
            "invalid": source.n_invalid,
            "color_bits": source.color_depth,
        }));
    }
    Ok(json!({
        "kind": "octree",
        "points": s.n_points,
        "records_read": s.n_read,
        "records_invalid": s.n_invalid,
        "columns": columns,
        "normals": {
            "asked": word(s.normals, &["auto", "file", "estimate", "none"]),
            "from_file": s.n_normals_file,
            "estimated": s.n_normals_estimated,
            "none": s.n_points - (s.n_normals_file + s.n_normals_estimated).min(s.n_points),
            "oriented": s.n_oriented,
            "estimated_oriented_by": word(s.orientation, &["nothing", "sensor", "up"]),
        },
        "sources": sources,
        "frame": frame(view.frame(), view.crs()?),
        "digest": format!("{:032x}", s.digest),
        "format": version(view.file().version()),
    }))
}

fn map(view: &MapView<'_>) -> Result<Value, FormatError> {
    let s = view.summary();
    let n = u128::from(s.n_surfels);
    Ok(json!({
        "kind": "map",
        "points": s.n_points,
        "surfels": s.n_surfels,
        "nodes": s.n_nodes,
        "leaf_pairs": (n * n.saturating_sub(1) / 2) as f64,
        "visible_pairs": s.n_visible_pairs as f64,
        "links": s.n_links,
        "fewer_links_percent": fewer_links(s.n_links, s.n_surfels),
        "config": view.config()?.trim_end(),
        "frame": frame(view.frame(), view.crs()?),
        "digest": format!("{:032x}", s.digest),
        "format": version(view.file().version()),
    }))
}

/// Gives the word for a code whose range the reader has checked.
fn word(code: u32, words: &[&'static str]) -> &'static str {
    words.get(code as usize).copied().unwrap_or_default()
}

fn version((major, minor): (u16, u16)) -> String {
    format!("{major}.{minor}")
}

fn frame(record: &FrameRecord, (kind, crs): (CrsKind, &[u8])) -> Value {
    let low = record.frame.world_of_real([0.0; 3]);
    json!({
        "coordinates": match record.frame {
            Frame::Lattice { .. } => "lattice",
            Frame::World { .. } => "real",
        },
        "origin": low,
        "extent": record.frame.extent(),
        "grid_step": record.frame.unit(),
        "crs": match kind {
            CrsKind::None => Value::Null,
            CrsKind::Wkt => String::from_utf8_lossy(crs).trim_end_matches('\0').into(),
            CrsKind::GeoTiff => format!("GeoTIFF keys, {} bytes", crs.len()).into(),
        },
    })
}

/// Prints an object as aligned lines, inner objects indented.
fn print(value: &Value, out: &mut impl Write) -> io::Result<()> {
    print_fields(value, 0, out)
}

fn print_fields(value: &Value, depth: usize, out: &mut impl Write) -> io::Result<()> {
    for (key, field) in value.as_object().into_iter().flatten() {
        let indent = "  ".repeat(depth);
        let key = key.replace('_', " ");
        match field {
            Value::Object(_) => {
                writeln!(out, "{indent}{key}")?;
                print_fields(field, depth + 1, out)?;
            }
            Value::Array(items) if items.iter().any(Value::is_object) => {
                for item in items {
                    writeln!(out, "{indent}{key}")?;
                    print_fields(item, depth + 1, out)?;
                }
            }
            _ => {
                let width = 22 - 2 * depth;
                writeln!(out, "{indent}{key:width$}{}", text(&key, field))?;
            }
        }
    }
    Ok(())
}

fn text(key: &str, value: &Value) -> String {
    match value {
        Value::Null => "none".to_owned(),
        Value::String(s) => s.replace('\n', ", "),
        Value::Array(items) => {
            let items: Vec<String> = items.iter().map(|v| text("", v)).collect();
            items.join(" ")
        }
        Value::Number(n) if key == "bytes" => {
            format!("{n} ({})", mib(n.as_u64().unwrap_or_default()))
        }
        Value::Number(n) if n.as_u64().is_none() && key.ends_with("pairs") => {
            format!("{:.0}", n.as_f64().unwrap_or_default())
        }
        other => other.to_string(),
    }
}
