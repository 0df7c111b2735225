//! How much light two elements exchange.

use std::f64::consts::PI;

use multiversion::multiversion;

use crate::element::{AREA, Columns, Elements, Record};
use crate::error::LightError;
use crate::exchange::Part;
use crate::hierarchy::Span;
use crate::number::{LANES, Number, across, copy_lanes, lanes};

/// The exchange between two elements that see each other, regularised and reciprocal:
///
/// G_ij = min(A_i, A_j, A_i A_j `[c_i]`+ `[c_j]`+ / (π r² + c (A_i + A_j))), G_ii = 0
///
/// c_i and c_j are the cosines at both; a two-sided element takes their size. c keeps near pairs
/// bounded: 0 is the raw kernel, 1 is right to first order for discs face to face, and 0.35 comes
/// nearest to rows that add up to 1 in a closed box (0.9987 to 1.0216).
///
/// Source: Goradia et al. 2007 §5.3; the regularisation is pvmap's own.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Kernel {
    regularisation: f64,
}

impl Default for Kernel {
    fn default() -> Kernel {
        Kernel { regularisation: 0.35 }
    }
}

impl Kernel {
    /// Makes a kernel of some c, at least 0.
    ///
    /// # Errors
    /// Where c is negative or not finite.
    pub fn new(regularisation: f64) -> Result<Kernel, LightError> {
        let is_legal = (0.0..f64::INFINITY).contains(&regularisation);
        is_legal.then_some(Kernel { regularisation }).ok_or(LightError::Setting {
            what: "the regularisation",
            value: regularisation,
            range: "0 or more",
        })
    }

    /// Gives c.
    pub fn regularisation(&self) -> f64 {
        self.regularisation
    }

    /// Gives the exchange G_ij = G_ji of two elements, the same bits either way; their form factors
    /// are G_ij / A_i and G_ij / A_j.
    pub fn exchange(&self, elements: &Elements, i: usize, j: usize) -> f64 {
        let [a, b] = [i, j].map(|index| elements.columns.record(index));
        exchange(self.regularisation, &a, &b)
    }

    /// Sums G_ij b_j over ranges of elements j, and parts of others, in an order that depends on
    /// these alone.
    pub(crate) fn row(&self, elements: &Elements, i: usize, from: From<'_>, b: &[f64]) -> f64 {
        let mut flux = [[0.0]];
        let c = self.regularisation;
        receive(c, &elements.columns, &[b], from, &mut Block::default(), i, &mut flux);
        flux[0][0]
    }
}

/// Where light comes from: ranges of elements, and those of which a part is seen.
pub(crate) type From<'a> = (&'a [Span], &'a [(Span, Part)]);

/// Sources put side by side, for many targets to take: so many at a time.
const SOURCES: usize = 256;

/// Elements that send, by column, and the exitance of each in each channel.
pub(crate) struct Block<T, const C: usize> {
    columns: [[T; SOURCES + LANES]; 8],
    exitances: [[T; SOURCES + LANES]; C],
    n: usize,
}

impl<T: Number, const C: usize> Default for Block<T, C> {
    fn default() -> Block<T, C> {
        let column = [T::default(); SOURCES + LANES];
        Block { columns: [column; 8], exitances: [column; C], n: 0 }
    }
}

impl<T: Number, const C: usize> Block<T, C> {
    /// Takes elements `from.0`…`from.1`, no more than lanes; says whether there is no room for
    /// more.
    #[inline(always)]
    fn push(
        &mut self,
        columns: &[&[T]; 8],
        b: &[&[T]; C],
        from: (usize, usize),
        part: Option<T>,
    ) -> bool {
        let n = self.n;
        for (column, to) in columns.iter().zip(&mut self.columns) {
            copy_lanes(column, from, &mut to[n..]);
        }
        for (b, to) in b.iter().zip(&mut self.exitances) {
            copy_lanes(b, from, &mut to[n..]);
            if let Some(part) = part {
                to[n..n + from.1 - from.0].iter_mut().for_each(|b| *b = part * *b);
            }
        }
        self.n = n + from.1 - from.0;
        self.n >= SOURCES
    }

    /// Adds what these send to elements from `first` on, and takes none any more.
    #[inline(always)]
    fn send(&mut self, c: T, columns: &Columns<T>, first: usize, flux: &mut [[f64; C]]) {
        // What has no area sends nothing: it fills up the last lanes.
        let whole = self.n.next_multiple_of(LANES);
        self.columns[AREA][self.n..whole].fill(T::default());
        self.n = 0;
        for (i, flux) in (first..).zip(flux) {
            let here = columns.record(i);
            let mut sums = [[T::default(); LANES]; C];
            let mut k = 0;
            while k < whole {
                let from = self.columns.each_ref().map(|column| lanes(column, k));
                let b = self.exitances.each_ref().map(|b| lanes(b, k));
                add(c, &here, from, b, &mut sums);
                k += LANES;
            }
            for (flux, sums) in flux.iter_mut().zip(&sums) {
                *flux += across(sums).wide();
            }
        }
    }
}

/// Adds to elements from `first` on what others send.
#[multiversion(targets = "simd")]
pub(crate) fn receive<T: Number, const C: usize>(
    c: T,
    columns: &Columns<T>,
    b: &[&[T]; C],
    (spans, parts): From<'_>,
    block: &mut Block<T, C>,
    first: usize,
    flux: &mut [[f64; C]],
) {
    // Cut to one length, which is then looked at once for all.
    let n = columns.0[0].len();
    let sources = columns.0.each_ref().map(|column| &column[..n]);
    let b = b.map(|b| &b[..n]);
    let whole = spans.iter().map(|&span| (span, None));
    let parts = parts.iter().map(|&(span, part)| (span, Some(T::of(part.share()))));
    for ((from, to), part) in whole.chain(parts) {
        let (mut from, to) = (from as usize, to as usize);
        while from < to {
            let next = to.min(from + LANES);
            if block.push(&sources, &b, (from, next), part) {
                block.send(c, columns, first, flux);
            }
            from = next;
        }
    }
    block.send(c, columns, first, flux);
}

#[inline(always)]
fn exchange<T: Number>(c: T, a: &Record<T>, b: &Record<T>) -> T {
    let (x, y, z) = (b[0] - a[0], b[1] - a[1], b[2] - a[2]);
    let r2 = x * x + y * y + z * z;
    // The cosines times r. Every operation is the same, or has its sign turned, from the other
    // end: reciprocity holds to the bit.
    let at_a = a[3] * x + a[4] * y + a[5] * z;
    let at_b = -(b[3] * x + b[4] * y + b[5] * z);
    let cosines = larger(at_a, -(at_a * a[7])) * larger(at_b, -(at_b * b[7]));
    let over = cosines * (a[AREA] * b[AREA]);
    let under = r2 * (T::of(PI) * r2 + c * (a[AREA] + b[AREA]));
    // In one place the cosines are 0, and so is what is exchanged, whatever the quotient says.
    let bounded = smaller(over / under, smaller(a[AREA], b[AREA]));
    if over > T::default() { bounded } else { T::default() }
}

/// `f64::max` without its care for NaN, one instruction.
#[inline(always)]
fn larger<T: Number>(a: T, b: T) -> T {
    if a > b { a } else { b }
}

#[inline(always)]
fn smaller<T: Number>(a: T, b: T) -> T {
    if a < b { a } else { b }
}

/// Adds what elements side by side send, their numbers by column.
#[inline(always)]
fn add<T: Number, const C: usize>(
    c: T,
    here: &Record<T>,
    from: [&[T; LANES]; 8],
    b: [&[T; LANES]; C],
    sums: &mut [[T; LANES]; C],
) {
    for lane in 0..LANES {
        let by = exchange(c, here, &from.map(|column| column[lane]));
        for channel in 0..C {
            sums[channel][lane] += by * b[channel][lane];
        }
    }
}
