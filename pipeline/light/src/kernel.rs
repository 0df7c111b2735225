//! How much light two elements exchange.

use std::f64::consts::PI;
use std::ops::Range;

use multiversion::multiversion;

use crate::element::{Elements, Record};
use crate::error::LightError;
use crate::exchange::Share;
use crate::hierarchy::Span;

/// Sources that are computed side by side.
pub(crate) const LANES: usize = 8;

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
        exchange(self.regularisation, &elements.records[i], &elements.records[j])
    }

    /// Sums G_ij b_j over ranges of elements j, in an order that depends on the ranges alone.
    pub(crate) fn row(&self, elements: &Elements, i: usize, ranges: &[Span], b: &[f64]) -> f64 {
        row(self.regularisation, elements, i, ranges, b)
    }

    /// Sums the part of G_ij b_j that shares say.
    pub(crate) fn row_of_shares(
        &self,
        elements: &Elements,
        i: usize,
        shares: &[Share],
        b: &[f64],
    ) -> f64 {
        row_of_shares(self.regularisation, elements, i, shares, b)
    }
}

/// Sources put side by side, for many targets to take: so many at a time.
const SOURCES: usize = 256;

/// Elements that send, by column, and the exitance of each.
pub(crate) struct Sources {
    columns: [[f64; SOURCES]; 8],
    exitances: [f64; SOURCES],
    n: usize,
}

impl Sources {
    pub(crate) fn new() -> Sources {
        Sources { columns: [[0.0; SOURCES]; 8], exitances: [0.0; SOURCES], n: 0 }
    }

    /// Takes an element; says whether there is no room for another.
    #[inline]
    pub(crate) fn push(&mut self, elements: &Elements, j: usize, exitance: f64) -> bool {
        for (column, v) in self.columns.iter_mut().zip(elements.records[j]) {
            column[self.n] = v;
        }
        self.exitances[self.n] = exitance;
        self.n += 1;
        self.n == SOURCES
    }

    /// Adds what these send to some elements, and takes none any more.
    pub(crate) fn send(&mut self, kernel: &Kernel, targets: &[Record], flux: &mut [f64]) {
        // What has no area sends nothing: it fills up the last lanes.
        let whole = self.n.next_multiple_of(LANES);
        self.columns[AREA][self.n..whole].fill(0.0);
        self.n = 0;
        let columns = self.columns.each_ref().map(|column| &column[..whole]);
        send(kernel.regularisation, columns, &self.exitances[..whole], targets, flux);
    }
}

impl Kernel {
    /// Adds what elements one after another send to some others; a multiple of [`LANES`] of them.
    pub(crate) fn send(
        &self,
        elements: &Elements,
        from: Range<usize>,
        b: &[f64],
        (targets, flux): (&[Record], &mut [f64]),
    ) {
        let columns = elements.columns().map(|column| &column[from.clone()]);
        send(self.regularisation, columns, &b[from], targets, flux);
    }
}

/// The column of areas.
const AREA: usize = 6;

#[multiversion(targets = "simd")]
fn send(c: f64, columns: [&[f64]; 8], b: &[f64], targets: &[Record], flux: &mut [f64]) {
    let [x, y, z, u, v, w, area, two_sided] = columns;
    for (here, flux) in targets.iter().zip(flux) {
        let mut sums = [0.0; LANES];
        let mut k = 0;
        while k < b.len() {
            let columns = [
                eight(x, k),
                eight(y, k),
                eight(z, k),
                eight(u, k),
                eight(v, k),
                eight(w, k),
                eight(area, k),
                eight(two_sided, k),
            ];
            add(c, here, columns, eight(b, k), &mut sums);
            k += LANES;
        }
        let mut sum = 0.0;
        for lane in 0..LANES {
            sum += sums[lane];
        }
        *flux += sum;
    }
}

#[inline(always)]
fn exchange(c: f64, a: &Record, b: &Record) -> f64 {
    let (x, y, z) = (b[0] - a[0], b[1] - a[1], b[2] - a[2]);
    let r2 = x * x + y * y + z * z;
    // The cosines times r. Every operation is the same, or has its sign turned, from the other
    // end: reciprocity holds to the bit.
    let at_a = a[3] * x + a[4] * y + a[5] * z;
    let at_b = -(b[3] * x + b[4] * y + b[5] * z);
    let cosines = larger(at_a, -(at_a * a[7])) * larger(at_b, -(at_b * b[7]));
    let over = cosines * (a[6] * b[6]);
    let under = r2 * (PI * r2 + c * (a[6] + b[6]));
    // In one place the cosines are 0, and so is what is exchanged, whatever the quotient says.
    let bounded = smaller(over / under, smaller(a[6], b[6]));
    if over > 0.0 { bounded } else { 0.0 }
}

/// `f64::max` without its care for NaN, one instruction.
#[inline(always)]
fn larger(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

#[inline(always)]
fn smaller(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
}

#[multiversion(targets = "simd")]
fn row(c: f64, elements: &Elements, i: usize, ranges: &[Span], b: &[f64]) -> f64 {
    let here = elements.records[i];
    let mut sums = [0.0; LANES];
    // What ranges leave over goes together: most of them are shorter than the lanes.
    let (mut waiting, mut n_waiting) = ([i; LANES], 0);
    for &(first, end) in ranges {
        let (first, end) = (first as usize, end as usize);
        let whole = end - (end - first) % LANES;
        if whole > first {
            let [x, y, z, u, v, w, area, two_sided] = elements.columns();
            let mut k = first;
            while k < whole {
                let columns = [
                    eight(x, k),
                    eight(y, k),
                    eight(z, k),
                    eight(u, k),
                    eight(v, k),
                    eight(w, k),
                    eight(area, k),
                    eight(two_sided, k),
                ];
                add(c, &here, columns, eight(b, k), &mut sums);
                k += LANES;
            }
        }
        for j in whole..end {
            waiting[n_waiting] = j;
            n_waiting += 1;
            if n_waiting == LANES {
                n_waiting = 0;
                let there = exitances(&waiting, b);
                gather(c, elements, &here, &waiting, &there, &mut sums);
            }
        }
    }
    // The element itself, with which it exchanges nothing, fills up the last ones.
    for free in &mut waiting[n_waiting..] {
        *free = i;
    }
    let there = exitances(&waiting, b);
    gather(c, elements, &here, &waiting, &there, &mut sums);
    let mut sum = 0.0;
    for lane in 0..LANES {
        sum += sums[lane];
    }
    sum
}

#[multiversion(targets = "simd")]
fn row_of_shares(c: f64, elements: &Elements, i: usize, shares: &[Share], b: &[f64]) -> f64 {
    let here = elements.records[i];
    let mut sums = [0.0; LANES];
    let (mut waiting, mut there, mut n_waiting) = ([i; LANES], [0.0; LANES], 0);
    for share in shares {
        let part = share.part();
        for j in share.elements.0 as usize..share.elements.1 as usize {
            (waiting[n_waiting], there[n_waiting]) = (j, part * b[j]);
            n_waiting += 1;
            if n_waiting == LANES {
                n_waiting = 0;
                gather(c, elements, &here, &waiting, &there, &mut sums);
            }
        }
    }
    for lane in n_waiting..LANES {
        (waiting[lane], there[lane]) = (i, 0.0);
    }
    gather(c, elements, &here, &waiting, &there, &mut sums);
    let mut sum = 0.0;
    for lane in 0..LANES {
        sum += sums[lane];
    }
    sum
}

/// Gives eight numbers of a column.
#[inline(always)]
pub(crate) fn eight(column: &[f64], first: usize) -> &[f64; LANES] {
    match column[first..].first_chunk() {
        Some(chunk) => chunk,
        None => unreachable!("whole chunks end within the column"),
    }
}

/// Gives the exitances of eight elements.
#[inline(always)]
fn exitances(from: &[usize; LANES], b: &[f64]) -> [f64; LANES] {
    let mut there = [0.0; LANES];
    for lane in 0..LANES {
        there[lane] = b[from[lane]];
    }
    there
}

/// Adds what eight elements anywhere send.
#[inline(always)]
fn gather(
    c: f64,
    elements: &Elements,
    here: &Record,
    from: &[usize; LANES],
    b: &[f64; LANES],
    sums: &mut [f64; LANES],
) {
    let mut columns = [[0.0; LANES]; 8];
    for lane in 0..LANES {
        let record = &elements.records[from[lane]];
        for column in 0..8 {
            columns[column][lane] = record[column];
        }
    }
    let [x, y, z, u, v, w, area, two_sided] = &columns;
    add(c, here, [x, y, z, u, v, w, area, two_sided], b, sums);
}

/// Adds what eight elements send, their numbers by column.
#[inline(always)]
fn add(c: f64, here: &Record, from: [&[f64; LANES]; 8], b: &[f64; LANES], sums: &mut [f64; LANES]) {
    let [x, y, z, u, v, w, area, two_sided] = from;
    for i in 0..LANES {
        let there = [x[i], y[i], z[i], u[i], v[i], w[i], area[i], two_sided[i]];
        sums[i] += exchange(c, here, &there) * b[i];
    }
}
