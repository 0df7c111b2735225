//! Variable length records, plain and extended: compression, extra bytes and the CRS.

use laz::LazVlr;
use pvmap_store::InputFile;

use super::extra::Described;
use super::header::Header;
use super::records::DESCRIPTOR_BYTES;
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
    /// What the bytes behind each point are.
    pub(crate) extra: Described,
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
        walk_plain(file, header, |vlr| records.keep(file, vlr, warnings))?;
        match records.read_extended(file, header, warnings) {
            Err(ScanError::Header { place, problem, .. }) if is_lenient => {
                warnings.push(format!("{place}: {problem}: not read"));
            }
            other => other?,
        }
        Ok(records)
    }

    /// Gives what extra bytes are, and the coordinate reference system; text wins over keys.
    pub(crate) fn into_extra_and_crs(self) -> (Described, Option<Crs>) {
        let of_keys = |keys| Crs::GeoTiff {
            keys,
            doubles: self.geo_doubles.unwrap_or_default(),
            texts: self.geo_texts.unwrap_or_default(),
        };
        (self.extra, self.wkt.map(Crs::Wkt).or_else(|| self.geo_keys.map(of_keys)))
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
                self.keep(file, vlr, warnings)?;
            } else if vlr.name.kind() != Kind::Other {
                warnings.push(format!("EVLR {i}: {} bytes are too many: not read", vlr.n_bytes));
            }
            Ok(())
        })
    }

    /// Reads a payload if it is one that matters; the first of a kind wins, but descriptors of
    /// extra bytes stand in as many records as a program likes.
    fn keep(
        &mut self,
        file: &InputFile,
        vlr: &VlrPlace,
        warnings: &mut Vec<String>,
    ) -> Result<(), ScanError> {
        let kind = vlr.name.kind();
        let slot = match kind {
            Kind::ExtraBytes => return self.describe(file, vlr, warnings),
            Kind::Laszip => &mut self.laszip,
            Kind::Wkt => &mut self.wkt,
            Kind::GeoKeys => &mut self.geo_keys,
            Kind::GeoDoubles => &mut self.geo_doubles,
            Kind::GeoTexts => &mut self.geo_texts,
            Kind::Copc | Kind::Other => return Ok(()),
        };
        if slot.is_none() {
            let mut payload = vec![0; vlr.n_bytes as usize];
            file.read_exact_at(&mut payload, vlr.payload_at)?;
            if kind == Kind::Wkt {
                // The text is a C string: the terminator is no part of it.
                while payload.last() == Some(&0) {
                    payload.pop();
                }
            }
            *slot = Some(payload);
        }
        Ok(())
    }

    /// Puts the descriptors of a record behind those there are.
    fn describe(
        &mut self,
        file: &InputFile,
        vlr: &VlrPlace,
        warnings: &mut Vec<String>,
    ) -> Result<(), ScanError> {
        let Described { descriptors, name } = &mut self.extra;
        name.get_or_insert(vlr.name);
        let n_had = descriptors.len();
        let n_bytes = vlr.n_bytes as usize / DESCRIPTOR_BYTES * DESCRIPTOR_BYTES;
        if n_had + n_bytes > KEPT_BYTES as usize {
            let n = n_bytes / DESCRIPTOR_BYTES;
            warnings.push(format!("{n} descriptors of extra bytes are too many: not read"));
            return Ok(());
        }
        descriptors.resize(n_had + n_bytes, 0);
        Ok(file.read_exact_at(&mut descriptors[n_had..], vlr.payload_at)?)
    }
}

/// What a record is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// Descriptors of extra bytes.
    ExtraBytes,
    /// How points are compressed.
    Laszip,
    /// The index of a COPC.
    Copc,
    Wkt,
    GeoKeys,
    GeoDoubles,
    GeoTexts,
    /// Something else.
    Other,
}

/// What the header of a record says beside its length, plain or extended.
#[derive(Debug, Clone, Copy)]
pub(crate) struct VlrName {
    reserved: [u8; 2],
    user_id: [u8; 16],
    record_id: u16,
    description: [u8; 32],
}

impl VlrName {
    /// What descriptors of extra bytes are called where a file has none.
    pub(crate) fn extra_bytes() -> VlrName {
        VlrName::new("LASF_Spec", 4, "extra bytes")
    }

    /// What the record is called that says how points are compressed.
    pub(crate) fn laszip() -> VlrName {
        VlrName::new(LazVlr::USER_ID, LazVlr::RECORD_ID, LazVlr::DESCRIPTION)
    }

    /// Names a record, in up to 16 and 32 characters of ASCII.
    pub(crate) fn new(user_id: &str, record_id: u16, description: &str) -> VlrName {
        fn filled<const N: usize>(text: &str) -> [u8; N] {
            let mut bytes = [0; N];
            bytes.iter_mut().zip(text.bytes()).for_each(|(slot, byte)| *slot = byte);
            bytes
        }
        VlrName {
            reserved: [0; 2],
            user_id: filled(user_id),
            record_id,
            description: filled(description),
        }
    }

    /// Takes the name out of a header, whose description is its end.
    fn of(head: &[u8]) -> VlrName {
        VlrName {
            reserved: take(head, 0),
            user_id: take(head, 2),
            record_id: u16_at(head, 18),
            description: take(head, head.len() - 32),
        }
    }

    /// Says what the record is about.
    pub(crate) fn kind(&self) -> Kind {
        let user = self.user_id.split(|&b| b == 0).next().unwrap_or_default();
        match (user, self.record_id) {
            (b"LASF_Spec", 4) => Kind::ExtraBytes,
            (b"laszip encoded", 22204) => Kind::Laszip,
            (b"copc", _) => Kind::Copc,
            (b"LASF_Projection", 2112) => Kind::Wkt,
            (b"LASF_Projection", 34735) => Kind::GeoKeys,
            (b"LASF_Projection", 34736) => Kind::GeoDoubles,
            (b"LASF_Projection", 34737) => Kind::GeoTexts,
            _ => Kind::Other,
        }
    }

    /// Gives the header of a plain record.
    pub(crate) fn plain(&self, n_bytes: u16) -> Vec<u8> {
        self.head(&n_bytes.to_le_bytes())
    }

    /// Gives the header of an extended record.
    pub(crate) fn extended(&self, n_bytes: u64) -> Vec<u8> {
        self.head(&n_bytes.to_le_bytes())
    }

    fn head(&self, n_bytes: &[u8]) -> Vec<u8> {
        let id = self.record_id.to_le_bytes();
        [&self.reserved[..], &self.user_id, &id, n_bytes, &self.description].concat()
    }
}

/// A record whose payload lies within the file.
#[derive(Debug, Clone, Copy)]
pub(crate) struct VlrPlace {
    pub(crate) name: VlrName,
    /// Where its header begins.
    pub(crate) at: u64,
    pub(crate) payload_at: u64,
    pub(crate) n_bytes: u64,
}

impl VlrPlace {
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
        let n_bytes = u64::from(u16_at(&head, 20));
        let vlr = VlrPlace { name: VlrName::of(&head), at, payload_at, n_bytes };
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
        let n_bytes = u64_at(&head, 20);
        if payload_at.saturating_add(n_bytes) > end {
            let problem = format!("{n_bytes} bytes at {payload_at} run past the end ({end})");
            return Err(fail(i, problem));
        }
        let vlr = VlrPlace { name: VlrName::of(&head), at, payload_at, n_bytes };
        at = vlr.end();
        visit(&vlr)?;
    }
    Ok(())
}
