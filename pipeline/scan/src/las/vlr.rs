//! Variable length records, plain and extended: compression, extra bytes and the CRS.

use pvmap_store::InputFile;

use super::header::Header;
use crate::bytes::{u16_at, u64_at};
use crate::error::ScanError;
use crate::source::Crs;

/// Bytes before the payload of a plain and of an extended record.
const VLR_HEADER_BYTES: u64 = 54;
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
        records.read_plain(file, header)?;
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

    fn read_plain(&mut self, file: &InputFile, header: &Header) -> Result<(), ScanError> {
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
            let n = u64::from(u16_at(&head, 20));
            at = payload_at + n;
            if at > header.points_offset {
                let end = header.points_offset;
                return Err(fail(i, format!("{n} bytes at {payload_at} run past byte {end}")));
            }
            self.keep(file, &head, payload_at, n)?;
        }
        Ok(())
    }

    fn read_extended(
        &mut self,
        file: &InputFile,
        header: &Header,
        warnings: &mut Vec<String>,
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
            let n = u64_at(&head, 20);
            at = payload_at.saturating_add(n);
            if at > end {
                return Err(fail(i, format!("{n} bytes at {payload_at} run past the end ({end})")));
            }
            if n <= KEPT_BYTES {
                self.keep(file, &head, payload_at, n)?;
            } else if &head[2..17] == b"LASF_Projection" {
                warnings.push(format!("EVLR {}: {n} bytes are too long for a CRS", i + 1));
            }
        }
        Ok(())
    }

    /// Reads a payload if it is one that matters; the first of a kind wins.
    fn keep(
        &mut self,
        file: &InputFile,
        head: &[u8],
        at: u64,
        n_bytes: u64,
    ) -> Result<(), ScanError> {
        let user = head[2..18].split(|&b| b == 0).next().unwrap_or_default();
        let slot = match (user, u16_at(head, 18)) {
            (b"laszip encoded", 22204) => &mut self.laszip,
            (b"LASF_Spec", 4) => &mut self.extra_bytes,
            (b"LASF_Projection", 2112) => &mut self.wkt,
            (b"LASF_Projection", 34735) => &mut self.geo_keys,
            (b"LASF_Projection", 34736) => &mut self.geo_doubles,
            (b"LASF_Projection", 34737) => &mut self.geo_texts,
            _ => return Ok(()),
        };
        if slot.is_none() {
            let mut payload = vec![0; n_bytes as usize];
            file.read_exact_at(&mut payload, at)?;
            if user == b"LASF_Projection" && u16_at(head, 18) == 2112 {
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
