//! Meshes of triangles as PLY files, also where gzip has packed them.
//!
//! A mesh is small beside a scan, so it is held whole, and `ply-rs` reads its rows: they are
//! mostly lists. Rows are taken in batches, so that a count of the header allocates nothing.

use std::io::{self, BufReader, BufWriter, ErrorKind, Read, Take, Write};
use std::path::Path;

use flate2::read::MultiGzDecoder;
use ply_rs::parser::{ParseError, Parser, Reader};
use ply_rs::ply::{
    Addable, DefaultElement, ElementDef, Encoding, Header, Property, PropertyAccess,
    PropertyAccessResult, PropertyDef, PropertyType, ScalarType,
};
use pvmap_store::{AtomicFile, InputFile, StoreError};

use crate::bytes::Window;
use crate::error::{ScanError, escaped};

/// The most bytes of an unpacked mesh: twice the largest of the well-known models (28 M triangles).
const MOST_BYTES: u64 = 1 << 30;
/// Rows held at a time beside the mesh itself.
const BATCH_ROWS: usize = 1 << 14;
/// What a gzip file begins with.
const GZIP: [u8; 2] = [0x1f, 0x8b];
/// A message of the parser may quote a line of the file.
const SHOWN_CHARS: usize = 160;

/// The content of a mesh file, as it stands there.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct MeshData {
    /// Where the corners are, in the file's own units.
    pub corners: Vec<[f64; 3]>,
    /// A normal a corner, where the file has nx, ny and nz.
    pub normals: Option<Vec<[f32; 3]>>,
    /// Indices of corners; a face of more than three corners becomes a fan of triangles. Nobody
    /// has checked that the corners are there.
    pub triangles: Vec<[u32; 3]>,
}

/// Reads corners and triangles of a PLY file.
///
/// # Errors
/// Where the file cannot be read, is no PLY file, is cut short or has no corners or no faces.
pub fn read_mesh(path: &Path) -> Result<MeshData, ScanError> {
    let file = InputFile::open(path)?;
    let mut magic = [0; 2];
    if file.len_bytes() >= 2 {
        file.read_exact_at(&mut magic, 0)?;
    }
    let bytes = Window::new(&file, 0, file.len_bytes());
    let stream: Box<dyn Read + '_> =
        if magic == GZIP { Box::new(MultiGzDecoder::new(bytes)) } else { Box::new(bytes) };
    let mut input = Reader::new(BufReader::with_capacity(1 << 18, stream.take(MOST_BYTES)));
    let len_bytes = (magic != GZIP).then_some(file.len_bytes());
    read(&mut input, len_bytes).map_err(|(place, problem)| match file.failure() {
        Some(failure) => failure.into(),
        None => ScanError::header(path, place, problem),
    })
}

type Input<'a> = Reader<BufReader<Take<Box<dyn Read + 'a>>>>;

/// What is wrong, and in which part of the file.
type Problem = (&'static str, String);

/// Reads a mesh from its first byte on; `len_bytes` is its length where that is known.
fn read(input: &mut Input<'_>, len_bytes: Option<u64>) -> Result<MeshData, Problem> {
    let broken = |problem: String| ("PLY header", problem);
    let header =
        Parser::<DefaultElement>::new().read_header(input).map_err(|e| broken(told(&e)))?;
    for element in header.elements.values() {
        check(element, header.encoding, len_bytes).map_err(broken)?;
    }
    let has = |element: &str, names: &[&str]| {
        let found = header.elements.get(element);
        let scalar = |p: &PropertyDef| matches!(p.data_type, PropertyType::Scalar(_));
        found.is_some_and(|e| names.iter().all(|n| e.properties.get(*n).is_some_and(scalar)))
    };
    if !has("vertex", &["x", "y", "z"]) {
        return Err(broken("not a mesh: no element vertex with x, y and z".to_owned()));
    }
    let is_list = |p: &PropertyDef| matches!(p.data_type, PropertyType::List(..));
    let faces = header.elements.get("face").filter(|e| e.count > 0);
    if !faces.is_some_and(|e| e.properties.values().any(|p| is_corners(&p.name) && is_list(p))) {
        return Err(broken("not a mesh: no element face with vertex_indices".to_owned()));
    }
    let mut mesh = MeshData::default();
    let mut normals = Vec::new();
    for (name, element) in &header.elements {
        match name.as_str() {
            "vertex" => rows(input, element, &header, |vertex: Vertex| {
                mesh.corners.push(vertex.position);
                normals.push(vertex.normal);
                Ok(())
            }),
            "face" => rows(input, element, &header, |face: Face| fan(&face, &mut mesh.triangles)),
            _ => rows(input, element, &header, |Skipped| Ok(())),
        }
        .map_err(|problem| ("PLY body", problem))?;
    }
    mesh.normals = has("vertex", &["nx", "ny", "nz"]).then_some(normals);
    Ok(mesh)
}

/// Refuses counts that cannot be.
fn check(element: &ElementDef, encoding: Encoding, len_bytes: Option<u64>) -> Result<(), String> {
    let (name, count) = (escaped(element.name.as_bytes(), 60), element.count as u64);
    let of = |p: &PropertyDef| match (encoding, &p.data_type) {
        // A digit and a blank.
        (Encoding::Ascii, _) => 2,
        (_, PropertyType::Scalar(kind) | PropertyType::List(kind, _)) => n_bytes(kind),
    };
    let least_bytes: u64 = element.properties.values().map(of).sum();
    if least_bytes == 0 && count > 0 {
        return Err(format!("element {name} has {count} rows without any property"));
    }
    // The last line of a text may lack its end.
    let most_bytes = len_bytes.unwrap_or(MOST_BYTES).min(MOST_BYTES) + 1;
    if count.saturating_mul(least_bytes) > most_bytes {
        let most = most_bytes / least_bytes;
        return Err(match len_bytes {
            Some(len) if len <= MOST_BYTES => {
                format!("declares {count} of {name}, the file can hold {most} at the most")
            }
            _ => format!("declares {count} of {name}, more than a mesh of 1 GiB can hold"),
        });
    }
    Ok(())
}

fn n_bytes(kind: &ScalarType) -> u64 {
    match kind {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    }
}

/// Reads all rows of an element, some at a time.
fn rows<E: PropertyAccess>(
    input: &mut Input<'_>,
    element: &ElementDef,
    header: &Header,
    mut each: impl FnMut(E) -> Result<(), String>,
) -> Result<(), String> {
    let parser = Parser::<E>::new();
    let mut batch = element.clone();
    let mut left = element.count;
    while left > 0 {
        batch.count = left.min(BATCH_ROWS);
        let read = parser.read_payload_for_element(input, &batch, header);
        for (row, at) in read.map_err(|e| unread(&e, input, element))?.into_iter().zip(0..) {
            each(row).map_err(|e| {
                let number: usize = element.count - left + at;
                format!("{} {number}: {e}", element.name)
            })?;
        }
        left -= batch.count;
    }
    Ok(())
}

/// Says why rows could not be read.
fn unread(e: &ParseError, input: &Input<'_>, element: &ElementDef) -> String {
    let (name, count) = (escaped(element.name.as_bytes(), 60), element.count);
    if input.get_ref().get_ref().limit() == 0 {
        return "is longer than 1 GiB".to_owned();
    }
    match e.kind() {
        ErrorKind::UnexpectedEof => format!("ends before the last of {count} rows of {name}"),
        _ => format!("rows of {name}: {}", told(e)),
    }
}

/// Puts a parser's message into one line.
fn told(e: &ParseError) -> String {
    let text = e.to_string().replace("\n\t", " ");
    escaped(text.trim().as_bytes(), SHOWN_CHARS)
}

/// Cuts a face into triangles.
fn fan(face: &Face, triangles: &mut Vec<[u32; 3]>) -> Result<(), String> {
    let corners = face.0.as_deref().ok_or("an index of a corner is negative or no whole number")?;
    if corners.len() < 3 {
        return Err(format!("{} corners, expected at least 3", corners.len()));
    }
    triangles.extend((2..corners.len()).map(|i| [corners[0], corners[i - 1], corners[i]]));
    Ok(())
}

fn is_corners(name: &str) -> bool {
    matches!(name, "vertex_indices" | "vertex_index")
}

/// What is read of a vertex.
struct Vertex {
    position: [f64; 3],
    normal: [f32; 3],
}

impl PropertyAccess for Vertex {
    fn new() -> Vertex {
        Vertex { position: [0.0; 3], normal: [0.0; 3] }
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        match property.to_f32_lossy() {
            Some(value) => self.set_float(name, value),
            None => PropertyAccessResult::Ignored,
        }
    }

    fn set_float(&mut self, name: &str, value: f32) -> PropertyAccessResult {
        self.set_double(name, f64::from(value))
    }

    fn set_int(&mut self, name: &str, value: i32) -> PropertyAccessResult {
        self.set_double(name, f64::from(value))
    }

    fn set_uint(&mut self, name: &str, value: u32) -> PropertyAccessResult {
        self.set_double(name, f64::from(value))
    }

    fn set_double(&mut self, name: &str, value: f64) -> PropertyAccessResult {
        match name {
            "x" => self.position[0] = value,
            "y" => self.position[1] = value,
            "z" => self.position[2] = value,
            "nx" => self.normal[0] = value as f32,
            "ny" => self.normal[1] = value as f32,
            "nz" => self.normal[2] = value as f32,
            _ => return PropertyAccessResult::Ignored,
        }
        PropertyAccessResult::Set
    }
}

/// The corners of a face; none where they cannot be indices.
struct Face(Option<Vec<u32>>);

impl PropertyAccess for Face {
    fn new() -> Face {
        Face(Some(Vec::new()))
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        if !is_corners(name) {
            return PropertyAccessResult::Ignored;
        }
        self.0 = property.to_u32_list();
        PropertyAccessResult::Set
    }
}

/// A row of which nothing is wanted.
struct Skipped;

impl PropertyAccess for Skipped {
    fn new() -> Skipped {
        Skipped
    }
}

/// Writes a mesh as a binary PLY file that appears under its name when it is whole: corners as
/// `double`, so that they are read back to the last bit, a colour a triangle.
///
/// # Errors
/// Where the file cannot be written or there are 2^31 corners or more.
///
/// # Panics
/// Where there are not as many colours as triangles.
pub fn write_mesh(
    path: &Path,
    corners: &[[f64; 3]],
    triangles: &[[u32; 3]],
    colors: &[[u8; 3]],
) -> Result<(), ScanError> {
    assert_eq!(triangles.len(), colors.len(), "a colour a triangle");
    if i32::try_from(corners.len()).is_err() {
        // Readers take indices for i32.
        let problem = format!("{} corners, a PLY mesh has fewer than 2^31", corners.len());
        return Err(ScanError::Write { path: path.to_path_buf(), problem });
    }
    let fail = |e| StoreError::io(path, "write", e);
    let mut out = BufWriter::with_capacity(1 << 20, AtomicFile::create(path)?);
    ply_rs::writer::Writer::<DefaultElement>::new()
        .write_header(&mut out, &mesh_header(corners.len(), triangles.len()))
        .map_err(|e| fail(io::Error::other(e)))?;
    for corner in corners {
        for c in corner {
            out.write_all(&c.to_le_bytes()).map_err(fail)?;
        }
    }
    for (triangle, color) in triangles.iter().zip(colors) {
        out.write_all(&[3]).map_err(fail)?;
        for corner in triangle {
            out.write_all(&corner.to_le_bytes()).map_err(fail)?;
        }
        out.write_all(color).map_err(fail)?;
    }
    let file = out.into_inner().map_err(|e| fail(e.into_error()))?;
    Ok(file.commit()?)
}

fn mesh_header(n_corners: usize, n_triangles: usize) -> Header {
    let element = |name: &str, count: usize, properties: Vec<(&str, PropertyType)>| {
        let mut element = ElementDef::new(name.to_owned());
        element.count = count;
        for (name, kind) in properties {
            element.properties.add(PropertyDef::new(name.to_owned(), kind));
        }
        element
    };
    let double = |name| (name, PropertyType::Scalar(ScalarType::Double));
    let byte = |name| (name, PropertyType::Scalar(ScalarType::UChar));
    let corners = ("vertex_indices", PropertyType::List(ScalarType::UChar, ScalarType::Int));
    let mut header = Header::new();
    header.encoding = Encoding::BinaryLittleEndian;
    header.elements.add(element("vertex", n_corners, ["x", "y", "z"].map(double).to_vec()));
    let face = vec![corners, byte("red"), byte("green"), byte("blue")];
    header.elements.add(element("face", n_triangles, face));
    header
}
