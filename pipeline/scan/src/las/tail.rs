//! What stands behind the points of a LAS or LAZ that is written again: everything, where it was,
//! but for records that are wrong now.

use std::ops::Range;

use pvmap_store::{InputFile, Watch};

use super::LasFile;
use super::vlr::{Kind, VlrName, walk_extended};
use crate::error::ScanError;
use crate::out::Out;
use crate::source::SourceInfo;

/// Pieces of the input in its order, whatever they are about.
#[derive(Debug, Default)]
pub(super) struct Tail {
    /// Up to the end of the extended records.
    pieces: Vec<Range<u64>>,
    /// What follows.
    rest: Range<u64>,
    /// Where the first extended record begins that stays, and how many do.
    first_evlr: Option<u64>,
    n_evlrs: u32,
}

/// Where things behind the points are in the output.
#[derive(Debug, Default)]
pub(super) struct Places {
    /// The first extended record, and how many there are.
    pub(super) first_evlr: u64,
    pub(super) n_evlrs: u32,
    /// What the header says where wave packets begin, if they moved.
    pub(super) waves: Option<u64>,
}

impl Tail {
    /// Finds the pieces. Of extended records that are cut off the bytes stay, not the records.
    pub(super) fn of(
        las: &LasFile,
        info: &SourceInfo,
        file: &InputFile,
    ) -> Result<Tail, ScanError> {
        let len = file.len_bytes();
        let mut tail = Tail::default();
        let mut at = las.end_of_points(info);
        let mut end = None;
        let walked = walk_extended(file, &las.header, |vlr| {
            match vlr.name.kind() {
                Kind::ExtraBytes | Kind::Laszip | Kind::Copc => {
                    tail.pieces.push(at..vlr.at);
                    at = vlr.end();
                }
                _ => {
                    tail.n_evlrs += 1;
                    tail.first_evlr.get_or_insert(vlr.at);
                }
            }
            end = Some(vlr.end());
            Ok(())
        });
        match walked {
            // Whether it may be cut off was decided when it was opened.
            Ok(()) | Err(ScanError::Header { .. }) => {}
            Err(e) => return Err(e),
        }
        let end = end.unwrap_or(len).max(at);
        tail.pieces.push(at..end);
        tail.rest = end..len.max(end);
        Ok(tail)
    }

    /// Gives the bytes of all pieces.
    fn n_bytes(&self) -> u64 {
        self.all().map(|p| p.end - p.start).sum()
    }

    fn all(&self) -> impl Iterator<Item = &Range<u64>> {
        self.pieces.iter().chain([&self.rest])
    }

    /// Appends the pieces and, as the last of the extended records, `ours`. `waves` is where the
    /// input has wave packets.
    pub(super) fn write(
        &self,
        (file, out): (&InputFile, &mut Out),
        waves: u64,
        ours: Option<(VlrName, &[u8])>,
        watch: &dyn Watch,
    ) -> Result<Places, ScanError> {
        let mut places = Places { n_evlrs: self.n_evlrs, ..Places::default() };
        let mut at = out.seek_end()?;
        if self.n_bytes() > 0 {
            watch.stage("rest", Some(self.n_bytes()), "bytes");
        }
        for (i, piece) in self.all().enumerate() {
            if i == self.pieces.len()
                && let Some((name, data)) = ours
            {
                if places.n_evlrs == 0 {
                    places.first_evlr = at;
                }
                places.n_evlrs += 1;
                out.put(&name.extended(data.len() as u64))?;
                out.put(data)?;
                at = out.position()?;
            }
            let moved = |was: u64| piece.contains(&was).then(|| at + (was - piece.start));
            places.waves = places.waves.or_else(|| moved(waves));
            places.first_evlr = self.first_evlr.and_then(moved).unwrap_or(places.first_evlr);
            out.copy(file, piece.clone(), watch)?;
            at += piece.end - piece.start;
        }
        Ok(places)
    }
}
