//! Variable length records, plain and extended: compression, extra bytes and the CRS.

use pvmap_store::InputFile;

use super::header::Header;
use crate::bytes::{take, u16_at, u64_at};
use crate::error::ScanError;
use crate::source::Crs;

/// Bytes before the payload of a plain and of an extended record.
pub(crate) const VLR_HEADER_BYTES: u64 = 54;
const EVLR_HEADER_BYTES: u64 = 60;

/// The longest payload that is kept: far above any WKT.
const KEPT_BYTES: u64 = 1 << 20;

/// The payloads that matter to a reader.
#[derive(Debug, Default)]
pub(crate) struct Records {
    /// How the points are compressed.
    pub(crate) laszip: Option<Vec<u8>>,
    /// What the bytes behind each point are: descriptors of 192 bytes.
    pub(crate) extra_bytes: Option<Vec<u8>>,
    wkt: Option<Vec<u8>>,
    geo_keys: Option<Vec<u8>>,
    geo_doubles: Option<Vec<u8>>,
    geo_texts: Option<Vec<u8>>,
}

impl Records {
    /// Walks all records of a file. Where `lenient`, extended ones that are cut off only warn.
    pub(crate) fn read(
        file: &InputFile,
        header: &Header,
        is_lenient: bool,
        warnings: &mut Vec<String>,
    ) -> Result<Records, ScanError> {
        let mut records = Records::default();
        walk_plain(file, header, |vlr| records.keep(file, vlr))?;
        match records.read_extended(file, header, warnings) {
            Err(ScanError::Header { place, problem, .. }) if is_lenient => {
                warnings.push(format!("{place}: {problem}: not read"));
            }
            other => other?,
        }
        Ok(records)
    }

    /// Gives the coordinate reference system; text wins over keys.
    pub(crate) fn into_crs(self) -> Option<Crs> {
        if let Some(text) = self.wkt {
            return Some(Crs::Wkt(text));
        }
        self.geo_keys.map(|keys| Crs::GeoTiff {
            keys,
            doubles: self.geo_doubles.unwrap_or_default(),
            texts: self.geo_texts.unwrap_or_default(),
        })
    }

    fn read_extended(
        &mut self,
        file: &InputFile,
        header: &Header,
        warnings: &mut Vec<String>,
    ) -> Result<(), ScanError> {
        let mut i = 0;
        walk_extended(file, header, |vlr| {
            i += 1;
            if vlr.n_bytes <= KEPT_BYTES {
                self.keep(file, vlr)?;
            } else if vlr.user() == b"LASF_Projection" {
                warnings.push(format!("EVLR {i}: {} bytes are too long for a CRS", vlr.n_bytes));
            }
            Ok(())
        })
    }

    /// Reads a payload if it is one that matters; the first of a kind wins.
    fn keep(&mut self, file: &InputFile, vlr: &VlrPlace) -> Result<(), ScanError> {
        let slot = match (vlr.user(), vlr.record_id) {
            (b"laszip encoded", 22204) => &mut self.laszip,
            (b"LASF_Spec", 4) => &mut self.extra_bytes,
            (b"LASF_Projection", 2112) => &mut self.wkt,
            (b"LASF_Projection", 34735) => &mut self.geo_keys,
            (b"LASF_Projection", 34736) => &mut self.geo_doubles,
            (b"LASF_Projection", 34737) => &mut self.geo_texts,
            _ => return Ok(()),
        };
        if slot.is_none() {
            let mut payload = vec![0; vlr.n_bytes as usize];
            file.read_exact_at(&mut payload, vlr.payload_at)?;
            if vlr.user() == b"LASF_Projection" && vlr.record_id == 2112 {
                // The text is a C string: the terminator is no part of it.
                while payload.last() == Some(&0) {
                    payload.pop();
                }
            }
            *slot = Some(payload);
        }
        Ok(())
    }
}

/// A record whose payload lies within the file.
#[derive(Debug, Clone, Copy)]
pub(crate) struct VlrPlace {
    user_id: [u8; 16],
    pub(crate) record_id: u16,
    /// Where its header begins.
    pub(crate) at: u64,
    pub(crate) payload_at: u64,
    pub(crate) n_bytes: u64,
}

impl VlrPlace {
    /// Gives its user id without the zeros behind it.
    pub(crate) fn user(&self) -> &[u8] {
        self.user_id.split(|&b| b == 0).next().unwrap_or_default()
    }

    /// Gives where it ends.
    pub(crate) fn end(&self) -> u64 {
        self.payload_at + self.n_bytes
    }
}

/// Shows the plain records of a file to `visit`; gives where they end.
pub(crate) fn walk_plain(
    file: &InputFile,
    header: &Header,
    mut visit: impl FnMut(&VlrPlace) -> Result<(), ScanError>,
) -> Result<u64, ScanError> {
    let room = header.points_offset - header.header_bytes;
    let fail = |i: u32, problem: String| {
        ScanError::header(file.path(), format!("VLR {} of {}", i + 1, header.n_vlrs), problem)
    };
    if u64::from(header.n_vlrs) > room / VLR_HEADER_BYTES {
        return Err(fail(0, format!("{room} bytes before the points cannot hold so many")));
    }
    let mut at = header.header_bytes;
    for i in 0..header.n_vlrs {
        let mut head = [0; VLR_HEADER_BYTES as usize];
        let payload_at = at + VLR_HEADER_BYTES;
        if payload_at > header.points_offset {
            return Err(fail(i, format!("its header at byte {at} runs into the points")));
        }
        file.read_exact_at(&mut head, at)?;
        let (record_id, n_bytes) = (u16_at(&head, 18), u64::from(u16_at(&head, 20)));
        let vlr = VlrPlace { user_id: take(&head, 2), record_id, at, payload_at, n_bytes };
        at = vlr.end();
        if at > header.points_offset {
            let end = header.points_offset;
            return Err(fail(i, format!("{n_bytes} bytes at {payload_at} run past byte {end}")));
        }
        visit(&vlr)?;
    }
    Ok(at)
}

/// Shows the extended records of a file to `visit`.
pub(crate) fn walk_extended(
    file: &InputFile,
    header: &Header,
    mut visit: impl FnMut(&VlrPlace) -> Result<(), ScanError>,
) -> Result<(), ScanError> {
    let end = file.len_bytes();
    let fail = |i: u32, problem: String| {
        ScanError::header(file.path(), format!("EVLR {} of {}", i + 1, header.n_evlrs), problem)
    };
    let mut at = header.evlrs_offset;
    if header.n_evlrs > 0 && at < header.points_offset {
        return Err(fail(0, format!("it begins at byte {at}, before the points")));
    }
    for i in 0..header.n_evlrs {
        let mut head = [0; EVLR_HEADER_BYTES as usize];
        let payload_at = at.saturating_add(EVLR_HEADER_BYTES);
        if payload_at > end {
            return Err(fail(i, format!("it begins at byte {at}, the file has {end}")));
        }
        file.read_exact_at(&mut head, at)?;
        let (record_id, n_bytes) = (u16_at(&head, 18), u64_at(&head, 20));
        if payload_at.saturating_add(n_bytes) > end {
            let problem = format!("{n_bytes} bytes at {payload_at} run past the end ({end})");
            return Err(fail(i, problem));
        }
        let vlr = VlrPlace { user_id: take(&head, 2), record_id, at, payload_at, n_bytes };
        at = vlr.end();
        visit(&vlr)?;
    }
    Ok(())
}
