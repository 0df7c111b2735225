//! The light file of a map: written from what was given and found for each surfel.

use std::fmt::Debug;
use std::path::Path;

use pvmap_store::output::{is_stdout, require_own};
use pvmap_store::sections::Section;
use pvmap_store::{AtomicFile, SectionFile, Watch};
use pvmap_vmap::container::{Written, head_bytes};
use pvmap_vmap::light::{Factors, Found, Given, Gloss, SkyShare, close_light, section_names};
use pvmap_vmap::records::Record;
use pvmap_vmap::{Kind, LightSummary};

use crate::Error;

/// One channel of a light file: a value for each surfel of the map, in their order.
#[derive(Debug, Clone, Copy)]
pub struct LightChannel<'a> {
    /// Exitance E that a surfel has by itself, flux an area.
    pub emission: &'a [f64],
    /// Share ρ of the light that arrives which it reflects in all directions, 0…1.
    pub albedo: &'a [f64],
    /// Irradiance H, flux an area, from all others, added lights and the sky.
    pub irradiance: &'a [f64],
}

/// What a light file is made of.
#[derive(Debug, Clone, Copy)]
pub struct LightContent<'a> {
    /// Its summary; `n_surfels` and `n_channels` are counted and need not be set.
    pub summary: LightSummary,
    /// The canonical text of what shines and what reflects.
    pub lights: &'a str,
    /// The effects that were and were not computed, a line each with its line feed.
    pub plan: &'a str,
    /// One for all light, or red, green and blue.
    pub channels: &'a [LightChannel<'a>],
    /// What each surfel mirrors and lets through, where something does. [F-33]
    pub gloss: Option<&'a [Gloss]>,
    /// The share of open sky above each surfel, 0…1, where it was computed. [F-29]
    pub sky: Option<&'a [f64]>,
    /// The area of each surfel and what its exchange was scaled with, above 0. [F-30]
    pub factors: &'a [Factors],
}

/// Writes a light file and gives its length in bytes. Stored are binary32 numbers; the radiosity
/// of a surfel is E + ρ·H of these.
///
/// Under its name the file is absent, old or whole at every time. Two runs that write one name do
/// not hinder each other: the later one stays.
///
/// # Errors
/// Where a value cannot be stored, a file of that name is no light file, the disk fails or `watch`
/// asks to stop.
///
/// # Panics
/// Where there are not as many values in every channel as in `factors`.
pub fn write_light(
    output: &Path,
    content: &LightContent<'_>,
    watch: &dyn Watch,
) -> Result<u64, Error> {
    content.require_equal_counts();
    require_free(output)?;
    let LightContent { channels, gloss, sky, factors, .. } = *content;
    let (n, n_channels) = (factors.len(), channels.len());
    let names = section_names(gloss.is_some(), sky.is_some());
    let file = SectionFile::create(output, head_bytes(names.len()))?;
    watch.stage("write", Some((n * names[N_TEXTS..].len()) as u64), "rows");
    let mut writing = Writing { file, sections: Vec::new(), n, watch };
    let summary =
        LightSummary { n_surfels: n as u32, n_channels: n_channels as u32, ..content.summary };
    writing.whole(&stored(&summary, "the summary", None)?, LightSummary::BYTES)?;
    writing.whole(content.lights.as_bytes(), 0)?;
    writing.whole(content.plan.as_bytes(), 0)?;
    writing.rows(n_channels, "emission and albedo", |i, c| channels[c].given(i))?;
    if let Some(gloss) = gloss {
        writing.rows(1, "gloss", |i, _| gloss[i])?;
    }
    writing.rows(n_channels, "light", |i, c| channels[c].found(i))?;
    if let Some(sky) = sky {
        writing.rows(1, "open sky", |i, _| SkyShare(sky[i] as f32))?;
    }
    writing.rows(1, "factors", |i, _| factors[i])?;
    writing.close(&names)
}

/// Refuses a name under which no light file can be made.
///
/// # Errors
/// Where it is that of a stream or of something else, or its folder cannot be written.
pub(crate) fn check_output(output: &Path) -> Result<(), Error> {
    if is_stdout(output) {
        let what = "a light file is not written from front to back; give the name of a file";
        return Err(Error::Usage(format!("{}: {what}", output.display())));
    }
    require_free(output)?;
    // Begun, and gone again.
    Ok(AtomicFile::create(output).map(drop)?)
}

fn require_free(output: &Path) -> Result<(), Error> {
    Ok(require_own(output, Kind::Light.start(), "a light file")?)
}

/// Sections before those with rows: `summary`, `lights`, `plan`.
const N_TEXTS: usize = 3;

/// Rows between two looks at whether to stop.
const ROWS_AT_ONCE: usize = 1 << 14;

impl LightContent<'_> {
    fn require_equal_counts(&self) {
        let n = self.factors.len();
        let of_channels = self.channels.iter().flat_map(|c| [c.emission, c.albedo, c.irradiance]);
        let all_equal = of_channels.chain(self.sky).all(|values| values.len() == n);
        let all_equal = all_equal && self.gloss.is_none_or(|gloss| gloss.len() == n);
        assert!(all_equal, "every surfel has a value in every channel");
        assert!([1, 3].contains(&self.channels.len()), "one channel or three");
    }
}

impl LightChannel<'_> {
    fn given(&self, i: usize) -> Given {
        Given { emission: self.emission[i] as f32, albedo: self.albedo[i] as f32 }
    }

    fn found(&self, i: usize) -> Found {
        let Given { emission, albedo } = self.given(i);
        let irradiance = self.irradiance[i] as f32;
        let radiosity = f64::from(emission) + f64::from(albedo) * f64::from(irradiance);
        Found { radiosity: radiosity as f32, irradiance }
    }
}

/// Gives the bytes of a record that may be read again.
fn stored<R: Record + Debug>(
    record: &R,
    what: &str,
    surfel: Option<usize>,
) -> Result<Vec<u8>, Error> {
    let bytes = record.to_bytes();
    if R::from_bytes(&bytes).is_some() {
        return Ok(bytes);
    }
    let whose = surfel.map_or(String::new(), |i| format!(" of surfel {i}"));
    Err(Error::Data(format!("{what}{whose} cannot be stored: {record:?}; are lights too bright?")))
}

/// A light file on its way.
struct Writing<'a> {
    file: SectionFile,
    /// With the bytes of a record.
    sections: Vec<(Section, usize)>,
    /// Surfels.
    n: usize,
    watch: &'a dyn Watch,
}

impl Writing<'_> {
    fn whole(&mut self, bytes: &[u8], record_bytes: usize) -> Result<(), Error> {
        self.sections.push((self.file.whole(bytes)?, record_bytes));
        Ok(())
    }

    /// Writes a section of `n_channels` records a surfel, as `row` gives them by surfel and
    /// channel.
    fn rows<R: Record + Debug>(
        &mut self,
        n_channels: usize,
        what: &str,
        row: impl Fn(usize, usize) -> R,
    ) -> Result<(), Error> {
        let mut section = self.file.stream();
        for first in (0..self.n).step_by(ROWS_AT_ONCE) {
            self.watch.check()?;
            let some = first..self.n.min(first + ROWS_AT_ONCE);
            self.watch.advance(some.len() as u64);
            for i in some {
                for channel in 0..n_channels {
                    section.append(&stored(&row(i, channel), what, Some(i))?)?;
                }
            }
        }
        self.sections.push((section.finish()?, R::BYTES * n_channels));
        Ok(())
    }

    /// Gives the file its head and its name; gives its length.
    fn close(self, names: &[&'static str]) -> Result<u64, Error> {
        self.sections.iter().try_for_each(|(section, _)| self.file.check(section))?;
        let table: Vec<Written> = self
            .sections
            .into_iter()
            .zip(names)
            .map(|((Section { offset_bytes, len_bytes, sums }, size), name)| Written {
                name,
                offset_bytes,
                len_bytes,
                record_bytes: size as u32,
                sums,
            })
            .collect();
        let closing = close_light(&table);
        self.watch.check()?;
        self.file.finish(&closing.head, &closing.sums, closing.sums_offset_bytes)?;
        Ok(closing.sums_offset_bytes + closing.sums.len() as u64)
    }
}
