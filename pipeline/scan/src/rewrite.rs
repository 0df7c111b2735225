//! A scan written again, record by record, as it is, with numbers of ours behind each record.
//!
//! [`crate::LasWriter`] and [`crate::PlyWriter`] write what this crate understands of a point.
//! Here all of a file comes through, what nobody understands too: records are bytes that are read,
//! lengthened and written.

use pvmap_geometry::Positions;
use pvmap_store::{AtomicFile, ClosedFile, InputFile, Watch};

use crate::error::ScanError;
use crate::field::ScalarField;
use crate::las::rewrite::LasRewrite;
use crate::out::refused;
use crate::ply::rewrite::PlyRewrite;
use crate::source::{Content, Source};

/// Most records at a time: as many as a reader has in its buffer, or fewer.
const MOST_RECORDS: u64 = 1 << 14;

/// What the records of a scan get, and where they go.
#[derive(Debug)]
pub struct RewriteOptions<'a> {
    /// The file to write.
    pub output: AtomicFile,
    /// LAZ instead of LAS; a PLY stays as it is.
    pub compressed: bool,
    /// The numbers behind each record, of names that it does not have ([`Source::names`]).
    pub fields: &'a [ScalarField],
    /// The program that wrote the file, in up to 31 ASCII characters: the software of a LAS, the
    /// first comment of a PLY.
    pub software: &'a str,
}

/// A scan that is being written again. Use: [`Rewrite::read`] and [`Rewrite::write`] in turn until
/// nothing is left, then [`Rewrite::close`].
pub struct Rewrite<'a> {
    source: &'a Source,
    input: &'a InputFile,
    content: Rewritten<'a>,
    warnings: Vec<String>,
}

enum Rewritten<'a> {
    Las(Box<LasRewrite<'a>>),
    Ply(Box<PlyRewrite<'a>>),
}

impl<'a> Rewrite<'a> {
    /// Writes all that stands before the records. `input` is the file of the source, opened again;
    /// `watch` hears of the bytes and may end the copying of them.
    ///
    /// # Errors
    /// Where the input is broken or was changed, a field cannot be written, the disk fails, or the
    /// run is asked to stop.
    pub fn begin(
        source: &'a Source,
        input: &'a InputFile,
        options: RewriteOptions<'_>,
        watch: &dyn Watch,
    ) -> Result<Rewrite<'a>, ScanError> {
        if let Some(problem) = options.fields.iter().find_map(ScalarField::problem) {
            return Err(refused(options.output.path(), problem));
        }
        let info = source.info();
        let mut warnings = Vec::new();
        let begun = match source.content() {
            Content::Las(las) => {
                LasRewrite::begin(las, (info, input), options, &mut warnings, watch)
                    .map(|las| Rewritten::Las(Box::new(las)))
            }
            Content::Ply(ply) => PlyRewrite::begin(ply, (info, input), options, watch)
                .map(|ply| Rewritten::Ply(Box::new(ply))),
        };
        Ok(Rewrite { source, input, content: source.settle(input, begun)?, warnings })
    }

    /// Tells what is not kept, a line each.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Reads some of the next records, up to `n`; gives their places, none at the end. A place that
    /// is not finite is one of them.
    ///
    /// # Errors
    /// Where a record cannot be decoded or the disk fails.
    pub fn read(&mut self, n: u64) -> Result<Positions, ScanError> {
        let n = n.min(MOST_RECORDS);
        let places = match &mut self.content {
            Rewritten::Las(las) => las.read(n),
            Rewritten::Ply(ply) => ply.read(n),
        };
        self.source.settle(self.input, places)
    }

    /// Says why reading ended before the last record, if it did: only of a lenient source.
    pub fn stopped(&self) -> Option<&str> {
        match &self.content {
            Rewritten::Las(las) => las.stopped(),
            Rewritten::Ply(_) => None,
        }
    }

    /// Writes the records that were read last, with the values of their fields: a column each.
    ///
    /// # Errors
    /// Where the values are not one a field and record, or the disk fails.
    pub fn write(&mut self, values: &[Vec<f64>]) -> Result<(), ScanError> {
        match &mut self.content {
            Rewritten::Las(las) => las.write(values),
            Rewritten::Ply(ply) => ply.write(values),
        }
    }

    /// Writes all that stands behind the records; the file has yet to get its name. `watch` hears
    /// of the bytes and may end the copying of them.
    ///
    /// # Errors
    /// Where the input is broken or was changed meanwhile, the disk fails, or the run is asked to
    /// stop.
    pub fn close(self, watch: &dyn Watch) -> Result<ClosedFile, ScanError> {
        let closed = match self.content {
            Rewritten::Las(las) => las.close(watch),
            Rewritten::Ply(ply) => ply.close(watch),
        };
        let closed = self.source.settle(self.input, closed)?;
        self.source.check_unchanged(self.input)?;
        Ok(closed)
    }
}
