//! Light on the surfels of a map as its reader sees it: a view of the bytes of a whole file.
//! Section 6 of FORMAT.md.

use crate::bytes::{FieldReader, FieldWriter};
use crate::container::{Closing, Container, Kind, Section, Written, close};
use crate::error::FormatError;
use crate::map::{record, single};
use crate::records::Record;

/// The sections of every light file in file order, without `gloss`, `sky` and `sums`.
const SECTIONS: [&str; 6] = ["summary", "lights", "plan", "given", "found", "factors"];

/// The section between `given` and `found` where something mirrors or lets light through. [F-33]
const GLOSS_SECTION: &str = "gloss";

/// The section between `found` and `factors` where it was computed. [F-29]
const SKY_SECTION: &str = "sky";

/// Names the sections of a light file in file order, without `sums`.
pub fn section_names(has_gloss: bool, has_sky: bool) -> Vec<&'static str> {
    let with = |name| match name {
        "found" if has_gloss => vec![GLOSS_SECTION, name],
        "factors" if has_sky => vec![SKY_SECTION, name],
        _ => vec![name],
    };
    SECTIONS.into_iter().flat_map(with).collect()
}

/// What a light file was made of and how well. Section 6 of FORMAT.md.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LightSummary {
    /// The root of the map it was made for.
    pub map: u128,
    /// Surfels of that map.
    pub n_surfels: u32,
    /// 1: all light; 3: red, green and blue.
    pub n_channels: u32,
    /// Order of the multipole expansions; 0: pair by pair.
    pub order: u32,
    /// Iterations of the solver, in the channel with the most.
    pub iterations: u32,
    /// Relative error of the radiosity that was asked for.
    pub error_target: f64,
    /// Mean relative error of what grids bring, at 64 surfels.
    pub operator_error: f64,
    /// Share of all area by which the rows of the scaled exchange are off.
    pub row_error: f64,
    /// Flux that may be wrong, as a share of what is emitted, in the channel with the most.
    pub residual: f64,
    /// What the scan's linear colours were multiplied with to be albedos.
    pub exposure: f64,
    /// Flux of each channel: emitted, absorbed, escaped, cut off below 0. Zeros where there is no
    /// such channel.
    pub balance: [[f64; 4]; 3],
}

/// What is wrong with the flux of a channel beyond its residual: rounding of its sums. [F-31]
const ROUNDING: f64 = 1e-9;

impl LightSummary {
    /// Says whether what is emitted in each channel is absorbed or escapes, but for the residual.
    fn adds_up(&self) -> bool {
        self.balance.iter().all(|&[emitted, absorbed, escaped, clipped]| {
            let off = (absorbed + escaped - emitted).abs();
            off <= (self.residual + ROUNDING) * emitted + clipped
        })
    }
}

impl Record for LightSummary {
    const BYTES: usize = 192;

    fn write(&self, w: &mut FieldWriter<'_>) {
        w.u128(self.map);
        w.u32(self.n_surfels);
        w.u32(self.n_channels);
        w.u32(self.order);
        w.u32(self.iterations);
        w.f64(self.error_target);
        w.f64(self.operator_error);
        w.f64(self.row_error);
        w.f64(self.residual);
        w.f64(self.exposure);
        self.balance.iter().flatten().for_each(|&flux| w.f64(flux));
    }

    fn read(r: &mut FieldReader<'_>) -> Option<LightSummary> {
        let summary = LightSummary {
            map: r.u128(),
            n_surfels: r.u32(),
            n_channels: r.u32(),
            order: r.u32(),
            iterations: r.u32(),
            error_target: r.f64(),
            operator_error: r.f64(),
            row_error: r.f64(),
            residual: r.f64(),
            exposure: r.f64(),
            balance: [(); 3].map(|()| [(); 4].map(|()| r.f64())),
        };
        let LightSummary { error_target, operator_error, row_error, residual, .. } = summary;
        let errors = [error_target, operator_error, row_error, residual, summary.exposure];
        let channels = |n: u32| summary.balance.iter().skip(n as usize);
        let fluxes = channels(0).all(|&[emitted, absorbed, escaped, clipped]| {
            [emitted, absorbed, clipped].into_iter().all(is_amount) && escaped.is_finite()
        });
        let legal = matches!(summary.n_channels, 1 | 3)
            && errors.into_iter().all(is_amount)
            && fluxes
            && channels(summary.n_channels).flatten().all(|&flux| flux == 0.0);
        legal.then_some(summary)
    }
}

/// Says whether a value is finite and not below 0.
fn is_amount(value: f64) -> bool {
    value >= 0.0 && value.is_finite()
}

/// What a surfel brings into one channel. [F-28]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Given {
    /// Exitance E that it has by itself, flux an area.
    pub emission: f32,
    /// Share ρ of the light that arrives which it reflects in all directions, 0…1.
    pub albedo: f32,
}

impl Record for Given {
    const BYTES: usize = 8;

    fn write(&self, w: &mut FieldWriter<'_>) {
        w.f32(self.emission);
        w.f32(self.albedo);
    }

    #[inline]
    fn read(r: &mut FieldReader<'_>) -> Option<Given> {
        let given = Given { emission: r.f32(), albedo: r.f32() };
        let is_share = (0.0..=1.0).contains(&given.albedo);
        (is_amount(given.emission.into()) && is_share).then_some(given)
    }
}

/// What a surfel mirrors and lets through, besides what it scatters. [F-33]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Gloss {
    /// Share that is mirrored, ks.
    pub specular: f32,
    /// Share that goes through, refracted, kt.
    pub transmissive: f32,
    /// Index of refraction behind the surface, at least 1; 1 bends nothing. 0 stands for 1.
    pub refraction: f32,
}

/// By how much the shares of a surfel may be above 1 in all: they are rounded to binary32. [F-33]
const SHARE_ROUNDING: f64 = 1e-5;

impl Gloss {
    /// Says whether anything is mirrored or let through.
    pub fn is_any(&self) -> bool {
        self.specular > 0.0 || self.transmissive > 0.0
    }

    /// Says whether it leaves room for what is scattered.
    fn fits(&self, given: &[Given; 3]) -> bool {
        let most = given.iter().map(|given| f64::from(given.albedo)).fold(0.0, f64::max);
        most + f64::from(self.specular) + f64::from(self.transmissive) <= 1.0 + SHARE_ROUNDING
    }
}

impl Record for Gloss {
    const BYTES: usize = 12;

    fn write(&self, w: &mut FieldWriter<'_>) {
        [self.specular, self.transmissive, self.refraction].into_iter().for_each(|v| w.f32(v));
    }

    fn read(r: &mut FieldReader<'_>) -> Option<Gloss> {
        let gloss = Gloss { specular: r.f32(), transmissive: r.f32(), refraction: r.f32() };
        let Gloss { specular, transmissive, refraction } = gloss;
        let values = [specular, transmissive, refraction];
        let are_amounts = values.into_iter().all(|value| is_amount(value.into()));
        let is_index = refraction == 0.0 || refraction >= 1.0;
        (are_amounts && is_index).then_some(gloss)
    }
}

/// The light of a surfel in one channel. [F-28]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Found {
    /// Radiosity B, flux an area that leaves it.
    pub radiosity: f32,
    /// Irradiance H, flux an area that arrives.
    pub irradiance: f32,
}

impl Found {
    /// Says whether the radiosity is what is emitted and reflected. [F-28]
    fn follows_from(&self, given: &Given) -> bool {
        let [b, h] = [self.radiosity, self.irradiance].map(f64::from);
        let leaves = f64::from(given.emission) + f64::from(given.albedo) * h;
        (b - leaves).abs() <= 1e-5 * b + 1e-37
    }
}

impl Record for Found {
    const BYTES: usize = 8;

    fn write(&self, w: &mut FieldWriter<'_>) {
        w.f32(self.radiosity);
        w.f32(self.irradiance);
    }

    #[inline]
    fn read(r: &mut FieldReader<'_>) -> Option<Found> {
        let found = Found { radiosity: r.f32(), irradiance: r.f32() };
        [found.radiosity, found.irradiance]
            .map(f64::from)
            .into_iter()
            .all(is_amount)
            .then_some(found)
    }
}

/// A row of `sky`: the share of the hemisphere above a surfel that is open sky. [F-29]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SkyShare(pub f32);

impl Record for SkyShare {
    const BYTES: usize = 4;

    fn write(&self, w: &mut FieldWriter<'_>) {
        w.f32(self.0);
    }

    fn read(r: &mut FieldReader<'_>) -> Option<SkyShare> {
        Some(SkyShare(r.f32())).filter(|share| (0.0..=1.0).contains(&share.0))
    }
}

/// What a surfel brings into the exchange, whatever shines. [F-30]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Factors {
    /// The area that it stands for, in square grid steps.
    pub area: f64,
    /// What its exchange was scaled with.
    pub scale: f64,
}

impl Record for Factors {
    const BYTES: usize = 16;

    fn write(&self, w: &mut FieldWriter<'_>) {
        w.f64(self.area);
        w.f64(self.scale);
    }

    fn read(r: &mut FieldReader<'_>) -> Option<Factors> {
        let factors = Factors { area: r.f64(), scale: r.f64() };
        let is_factor = |v: f64| v > 0.0 && v.is_finite();
        (is_factor(factors.area) && is_factor(factors.scale)).then_some(factors)
    }
}

/// An open light file. Opening reads the header, the table and the summary; rows are read, and
/// their checksums checked, when they are asked for.
#[derive(Debug)]
pub struct LightView<'a> {
    file: Container<'a>,
    summary: LightSummary,
    given: Section,
    found: Section,
    factors: Section,
    /// Where something mirrors or lets light through.
    gloss: Option<Section>,
    /// Where it was computed.
    sky: Option<Section>,
}

impl<'a> LightView<'a> {
    /// Opens the bytes of a whole file.
    ///
    /// # Errors
    /// Where they are no light file that can be read, or what opening reads is damaged.
    pub fn open(bytes: &'a [u8]) -> Result<LightView<'a>, FormatError> {
        let file = Container::open(bytes, Kind::Light)?;
        let summary: LightSummary = single(&file, "summary")?;
        let rows = |name: &str, bytes: usize| {
            let section = file.section(name, bytes as u32)?.clone();
            let (found, expected) = (section.n_records, summary.n_surfels);
            if found == u64::from(expected) {
                return Ok(section);
            }
            Err(section.broken(0, format!("{found} records, summary says {expected}")))
        };
        let n_channels = summary.n_channels as usize;
        let given = rows("given", Given::BYTES * n_channels)?;
        let found = rows("found", Found::BYTES * n_channels)?;
        let factors = rows("factors", Factors::BYTES)?;
        let has = |name: &str| file.sections().iter().any(|section| section.name == name);
        let optional = |name, bytes| has(name).then(|| rows(name, bytes)).transpose();
        let gloss = optional(GLOSS_SECTION, Gloss::BYTES)?;
        let sky = optional(SKY_SECTION, SkyShare::BYTES)?;
        Ok(LightView { summary, given, found, factors, gloss, sky, file })
    }

    /// Gives the file around the sections.
    pub fn file(&self) -> &Container<'a> {
        &self.file
    }

    /// Gives what it was made of and how well.
    pub fn summary(&self) -> &LightSummary {
        &self.summary
    }

    /// Reads what a surfel brings, `surfel` < `n_surfels`: red, green, blue; with one channel all
    /// three alike.
    ///
    /// # Errors
    /// Where there is none of that id, or its block or row is damaged.
    pub fn given(&self, surfel: u32) -> Result<[Given; 3], FormatError> {
        self.channels(&self.given, surfel)
    }

    /// Reads the light of a surfel, as [`Self::given`].
    ///
    /// # Errors
    /// As there.
    pub fn found(&self, surfel: u32) -> Result<[Found; 3], FormatError> {
        self.channels(&self.found, surfel)
    }

    fn channels<R: Record + Copy>(
        &self,
        section: &Section,
        surfel: u32,
    ) -> Result<[R; 3], FormatError> {
        let n = u64::from(self.summary.n_channels);
        let channel = |i: u64| record(&self.file, section, u64::from(surfel) * n + i);
        let first = channel(0)?;
        match n {
            1 => Ok([first; 3]),
            _ => Ok([first, channel(1)?, channel(2)?]),
        }
    }

    /// Reads the area of a surfel and what its exchange was scaled with, `surfel` < `n_surfels`.
    ///
    /// # Errors
    /// As [`Self::given`].
    pub fn factors(&self, surfel: u32) -> Result<Factors, FormatError> {
        record(&self.file, &self.factors, surfel.into())
    }

    /// Says whether anything mirrors or lets light through.
    pub fn has_gloss(&self) -> bool {
        self.gloss.is_some()
    }

    /// Reads what a surfel mirrors and lets through, `surfel` < `n_surfels`; none where nothing of
    /// the scan does.
    ///
    /// # Errors
    /// As [`Self::given`].
    pub fn gloss(&self, surfel: u32) -> Result<Option<Gloss>, FormatError> {
        self.gloss.as_ref().map(|rows| record(&self.file, rows, surfel.into())).transpose()
    }

    /// Says whether shares of open sky were computed.
    pub fn has_sky(&self) -> bool {
        self.sky.is_some()
    }

    /// Reads the share of the hemisphere above a surfel that is open sky, weighted with the cosine,
    /// `surfel` < `n_surfels`; none where it was not computed.
    ///
    /// # Errors
    /// As [`Self::given`].
    pub fn sky(&self, surfel: u32) -> Result<Option<f32>, FormatError> {
        let share = |sky| Ok(record::<SkyShare>(&self.file, sky, surfel.into())?.0);
        self.sky.as_ref().map(share).transpose()
    }

    /// Gives the canonical text of what shines and what reflects.
    ///
    /// # Errors
    /// Where the section is damaged.
    pub fn lights(&self) -> Result<&'a str, FormatError> {
        self.text("lights")
    }

    /// Gives the effects that were and were not computed, a line each.
    ///
    /// # Errors
    /// Where the section is damaged.
    pub fn plan(&self) -> Result<&'a str, FormatError> {
        self.text("plan")
    }

    fn text(&self, name: &str) -> Result<&'a str, FormatError> {
        let section = self.file.section(name, 0)?;
        let text = std::str::from_utf8(self.file.read_all(section)?);
        text.map_err(|e| section.broken(e.valid_up_to() as u64, "not UTF-8"))
    }

    /// Checks every byte and every rule of FORMAT.md.
    ///
    /// # Errors
    /// The first damage found.
    pub fn verify(&self) -> Result<(), FormatError> {
        self.verify_telling(&mut |_| ())
    }

    /// Counts the bytes that verifying goes through: the whole file, then the rows again.
    pub fn verify_bytes(&self) -> u64 {
        let always = [&self.given, &self.found, &self.factors];
        let rows = always.into_iter().chain(&self.gloss).chain(&self.sky);
        self.file.len_bytes() + rows.map(|section| section.len_bytes).sum::<u64>()
    }

    /// Does what [`Self::verify`] does; `tell` gets the number of bytes gone through, again and
    /// again, in all about [`Self::verify_bytes`].
    ///
    /// # Errors
    /// The first damage found.
    pub fn verify_telling(&self, tell: &mut dyn FnMut(u64)) -> Result<(), FormatError> {
        self.file.verify(tell)?;
        self.lights()?;
        let plan = self.plan()?;
        if !plan.is_empty() && !plan.ends_with('\n') {
            return Err(self.file.section("plan", 0)?.broken(0, "its last line has no end"));
        }
        if !self.summary.adds_up() {
            let summary = self.file.section("summary", LightSummary::BYTES as u32)?;
            return Err(summary.broken(0, "flux is lost or gained beyond the residual"));
        }
        let n = u64::from(self.summary.n_surfels);
        let row_bytes = (self.verify_bytes() - self.file.len_bytes()).checked_div(n).unwrap_or(0);
        for surfel in 0..self.summary.n_surfels {
            self.verify_surfel(surfel)?;
            tell(row_bytes);
        }
        Ok(())
    }

    fn verify_surfel(&self, surfel: u32) -> Result<(), FormatError> {
        let (given, found) = (self.given(surfel)?, self.found(surfel)?);
        if !given.iter().zip(&found).all(|(given, found)| found.follows_from(given)) {
            let at = u64::from(surfel) * u64::from(self.found.record_bytes);
            let what = format!("surfel {surfel}: the radiosity is not what it emits and reflects");
            return Err(self.found.broken(at, what));
        }
        if let (Some(gloss), Some(section)) = (self.gloss(surfel)?, &self.gloss)
            && !gloss.fits(&given)
        {
            let at = u64::from(surfel) * u64::from(section.record_bytes);
            let what = format!("surfel {surfel}: it scatters, mirrors and lets through above 1");
            return Err(section.broken(at, what));
        }
        self.factors(surfel)?;
        self.sky(surfel)?;
        Ok(())
    }
}

/// Makes what closes a light file, from its sections in the order of [`section_names`].
pub fn close_light(sections: &[Written]) -> Closing {
    let are = |names: Vec<&str>| sections.iter().map(|s| s.name).eq(names);
    let with = [(false, false), (false, true), (true, false), (true, true)];
    let are_in_order = with.into_iter().any(|(gloss, sky)| are(section_names(gloss, sky)));
    debug_assert!(are_in_order, "sections in file order");
    close(Kind::Light, sections)
}
