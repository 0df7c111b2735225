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
use pvmap_store::{AtomicFile, InputFile, StoreError, memory};

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
    /// Faces of fewer than three corners, which some tools write. They hide nothing and are left
    /// out.
    pub n_flat_faces: u64,
}

/// What the reader of a mesh, and who it is read for, may hold of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MeshMemory {
    /// In all.
    pub total_bytes: u64,
    /// What else will be held for each corner.
    pub corner_bytes: u64,
    /// What else will be held for each triangle.
    pub triangle_bytes: u64,
}

impl MeshMemory {
    /// Takes bytes for nothing but the mesh as it was read.
    pub fn of_mesh(total_bytes: u64) -> MeshMemory {
        MeshMemory { total_bytes, corner_bytes: 0, triangle_bytes: 0 }
    }

    /// Gives what is needed for a mesh.
    pub fn needed(&self, mesh: &MeshData) -> u64 {
        self.needed_for(mesh.corners.len() as u64, mesh.triangles.len() as u64)
    }

    fn needed_for(&self, n_corners: u64, n_triangles: u64) -> u64 {
        // Twice, for a list that grows is copied.
        let corner = 2 * size_of::<Vertex>() as u64 + self.corner_bytes;
        let triangle = 2 * size_of::<[u32; 3]>() as u64 + self.triangle_bytes;
        n_corners.saturating_mul(corner).saturating_add(n_triangles.saturating_mul(triangle))
    }

    /// Refuses a mesh of so many corners and triangles where that is too much.
    fn require(&self, n_corners: u64, n_triangles: u64) -> Result<(), StoreError> {
        let need_bytes = self.needed_for(n_corners, n_triangles);
        memory::require("the triangles of a mesh", need_bytes, self.total_bytes)
    }
}

/// Reads corners and triangles of a PLY file.
///
/// # Errors
/// Where the file cannot be read, is no PLY file, is cut short, has no corners or no faces or more
/// than `memory` holds.
pub fn read_mesh(path: &Path, memory: MeshMemory) -> Result<MeshData, ScanError> {
    let file = InputFile::open(path)?;
    let mut magic = [0; 2];
    if file.len_bytes() >= 2 {
        file.read_exact_at(&mut magic, 0)?;
    }
    let bytes = Window::new(&file, 0, file.len_bytes());
    let stream: Box<dyn Read + '_> =
        if magic == GZIP { Box::new(MultiGzDecoder::new(bytes)) } else { Box::new(bytes) };
    let len_bytes = (magic != GZIP).then_some(file.len_bytes());
    read(&mut input(stream, MOST_BYTES), len_bytes, memory).map_err(|problem| {
        match (file.failure(), problem) {
            (Some(failure), _) => failure.into(),
            (None, Problem::Broken(place, problem)) => ScanError::header(path, place, problem),
            (None, Problem::TooLarge(e)) => e.into(),
        }
    })
}

type Input<'a> = Reader<BufReader<Take<Box<dyn Read + 'a>>>>;

/// Makes the input of a file of at most `most_bytes`. One byte more is read, if there is one, so
/// that a file of just so many which is cut short is not taken for a longer one.
fn input(stream: Box<dyn Read + '_>, most_bytes: u64) -> Input<'_> {
    Reader::new(BufReader::with_capacity(1 << 18, stream.take(most_bytes + 1)))
}

enum Problem {
    /// What is wrong, and in which part of the file.
    Broken(&'static str, String),
    TooLarge(StoreError),
}

impl From<StoreError> for Problem {
    fn from(e: StoreError) -> Problem {
        Problem::TooLarge(e)
    }
}

impl From<String> for Problem {
    fn from(problem: String) -> Problem {
        Problem::Broken("PLY body", problem)
    }
}

/// Reads a mesh from its first byte on; `len_bytes` is its length where that is known.
fn read(
    input: &mut Input<'_>,
    len_bytes: Option<u64>,
    memory: MeshMemory,
) -> Result<MeshData, Problem> {
    let broken = |problem: String| Problem::Broken("PLY header", problem);
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
    let count = |name: &str| header.elements.get(name).map_or(0, |e| e.count as u64);
    memory.require(count("vertex"), count("face"))?;
    let mut mesh = MeshData::default();
    let mut normals = Vec::new();
    for (name, element) in &header.elements {
        match name.as_str() {
            "vertex" => rows(input, element, &header, |vertex: Vertex| {
                mesh.corners.push(vertex.position);
                normals.push(vertex.normal);
                Ok(())
            }),
            "face" => rows(input, element, &header, |face: Face| {
                fan(&face, &mut mesh)?;
                Ok(memory.require(mesh.corners.len() as u64, mesh.triangles.len() as u64)?)
            }),
            _ => rows(input, element, &header, |Skipped| Ok(())),
        }?;
    }
    // Once more, for faces may come before the corners.
    memory.require(mesh.corners.len() as u64, mesh.triangles.len() as u64)?;
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
    mut each: impl FnMut(E) -> Result<(), Problem>,
) -> Result<(), Problem> {
    let parser = Parser::<E>::new();
    let mut batch = element.clone();
    let mut left = element.count;
    while left > 0 {
        batch.count = left.min(BATCH_ROWS);
        let read = parser.read_payload_for_element(input, &batch, header);
        for (row, at) in read.map_err(|e| unread(&e, input, element))?.into_iter().zip(0..) {
            each(row).map_err(|e| match e {
                Problem::Broken(place, problem) => {
                    let number: usize = element.count - left + at;
                    Problem::Broken(place, format!("{} {number}: {problem}", element.name))
                }
                too_large => too_large,
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
fn fan(face: &Face, mesh: &mut MeshData) -> Result<(), String> {
    let corners = face.0.as_deref().ok_or("an index of a corner is negative or no whole number")?;
    mesh.n_flat_faces += u64::from(corners.len() < 3);
    mesh.triangles.extend((2..corners.len()).map(|i| [corners[0], corners[i - 1], corners[i]]));
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
pub struct MeshWriter {
    file: AtomicFile,
}

impl MeshWriter {
    /// Starts a file.
    ///
    /// # Errors
    /// Where it cannot be created.
    pub fn create(path: &Path) -> Result<MeshWriter, ScanError> {
        Ok(MeshWriter { file: AtomicFile::create(path)? })
    }

    /// Writes everything and gives the file its name.
    ///
    /// # Errors
    /// Where the disk fails or there are 2^31 corners or more.
    ///
    /// # Panics
    /// Where there are not as many colours as triangles.
    pub fn finish(
        self,
        corners: &[[f64; 3]],
        triangles: &[[u32; 3]],
        colors: &[[u8; 3]],
    ) -> Result<(), ScanError> {
        assert_eq!(triangles.len(), colors.len(), "a colour a triangle");
        let path = self.file.path().to_path_buf();
        if i32::try_from(corners.len()).is_err() {
            // Readers take indices for i32.
            let problem = format!("{} corners, a PLY mesh has fewer than 2^31", corners.len());
            return Err(ScanError::Write { path, problem });
        }
        let mut out = BufWriter::with_capacity(1 << 20, self.file);
        write_rows(&mut out, corners, triangles, colors)
            .map_err(|e| StoreError::io(&path, "write", e))?;
        let file = out.into_inner().map_err(|e| StoreError::io(&path, "write", e.into_error()))?;
        Ok(file.commit()?)
    }
}

fn write_rows(
    out: &mut impl Write,
    corners: &[[f64; 3]],
    triangles: &[[u32; 3]],
    colors: &[[u8; 3]],
) -> io::Result<()> {
    ply_rs::writer::Writer::<DefaultElement>::new()
        .write_header(out, &mesh_header(corners.len(), triangles.len()))
        .map_err(io::Error::other)?;
    for corner in corners {
        for c in corner {
            out.write_all(&c.to_le_bytes())?;
        }
    }
    for (triangle, color) in triangles.iter().zip(colors) {
        out.write_all(&[3])?;
        for corner in triangle {
            out.write_all(&corner.to_le_bytes())?;
        }
        out.write_all(color)?;
    }
    Ok(())
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Says what is wrong with a file of which at most `most_bytes` are read.
    fn problem(bytes: &[u8], most_bytes: u64) -> Option<String> {
        let memory = MeshMemory::of_mesh(1 << 20);
        match read(&mut input(Box::new(bytes), most_bytes), None, memory) {
            Ok(_) => None,
            Err(Problem::Broken(_, problem)) => Some(problem),
            Err(Problem::TooLarge(e)) => Some(e.to_string()),
        }
    }

    #[test]
    fn a_mesh_of_the_most_bytes_is_whole_cut_short_or_too_long() {
        let mut file = b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n\
            property float x\nproperty float y\nproperty float z\nelement face 2\n\
            property list uchar int vertex_indices\nend_header\n"
            .to_vec();
        file.extend([0; 36]);
        file.extend([3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0].repeat(2));
        let most = file.len() as u64;
        assert_eq!(problem(&file, most), None);
        let cut = &file[..file.len() - 1];
        let ends = "ends before the last of 2 rows of face";
        for most in [most, most - 1] {
            assert_eq!(problem(cut, most).as_deref(), Some(ends));
        }
        assert_eq!(problem(cut, most - 2).as_deref(), Some("is longer than 1 GiB"));
    }
}
