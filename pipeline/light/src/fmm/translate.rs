//! The field of some places at others.

use std::array::from_fn;
use std::f64::consts::PI;

use multiversion::multiversion;

use crate::exchange::Part;
use crate::fmm::grid::Vectors;
use crate::fmm::station::{Partner, Place, Stations};
use crate::number::{LANES, Number, across, lanes};

/// Places put side by side: so many at a time.
const SOURCES: usize = 256;

/// A place with the vectors at it: they are read together, and far apart in memory from others.
#[derive(Clone, Copy)]
pub(crate) struct Source<T, const C: usize> {
    pub(crate) place: Place<T>,
    pub(crate) vectors: Vectors<T, C>,
}

/// Places, what softens their exchange and the vectors at them, by column.
pub(crate) struct Columns<T, const C: usize> {
    places: [[T; SOURCES]; 4],
    vectors: [[[T; SOURCES]; 3]; C],
    n: usize,
}

impl<T: Number, const C: usize> Default for Columns<T, C> {
    fn default() -> Columns<T, C> {
        let column = [T::default(); SOURCES];
        Columns { places: [column; 4], vectors: [[column; 3]; C], n: 0 }
    }
}

impl<T: Number, const C: usize> Columns<T, C> {
    /// Takes a source; says whether there is no room for another.
    #[inline(always)]
    fn push(&mut self, Source { place, vectors }: &Source<T, C>, weight: T) -> bool {
        let n = self.n;
        if n >= SOURCES {
            unreachable!("what is full is sent");
        }
        for i in 0..4 {
            self.places[i][n] = place[i];
        }
        for channel in 0..C {
            for axis in 0..3 {
                self.vectors[channel][axis][n] = weight * vectors[channel][axis];
            }
        }
        self.n = n + 1;
        n + 1 == SOURCES
    }

    /// Adds the field of what was taken at some places, and forgets it.
    #[inline(always)]
    fn send(&mut self, targets: &[Place<T>], field: &mut [Vectors<T, C>]) {
        // Places without a vector, where the last one is, fill up the last lanes.
        let whole = self.n.next_multiple_of(LANES);
        for n in self.n..whole {
            self.places.iter_mut().for_each(|column| column[n] = column[n - 1]);
            self.vectors.as_flattened_mut().iter_mut().for_each(|column| column[n] = T::default());
        }
        self.n = 0;
        for (target, field) in targets.iter().zip(field) {
            let mut sums = [[[T::default(); LANES]; 3]; C];
            let mut k = 0;
            while k < whole {
                let places = self.places.each_ref().map(|column| lanes(column, k));
                let vectors =
                    from_fn(|c| self.vectors[c].each_ref().map(|column| lanes(column, k)));
                add(target, places, vectors, &mut sums);
                k += LANES;
            }
            for (field, sums) in field.as_flattened_mut().iter_mut().zip(sums.as_flattened()) {
                *field += across(sums);
            }
        }
    }
}

/// What a station exchanges light with, and that of which it sees a part.
pub(crate) type Partners<'a> = (&'a [Partner], &'a [(Partner, Part)]);

/// Adds the field of vectors m at the places of a station's partners to that at some places:
/// f_i += Σ_j ± r (r·m_j) / (r² (π r² + s_i + s_j)), r = x_j - x_i (M2L, and what joins a grid with
/// elements).
///
/// s is c times the area of an element, or of the middle of those that a grid stands for. r is
/// never 0: what is far apart only comes here.
#[multiversion(targets = "simd")]
pub(crate) fn translate<T: Number, const C: usize>(
    (stations, (partners, parts)): (&Stations, Partners<'_>),
    sources: &[Source<T, C>],
    columns: &mut Columns<T, C>,
    targets: &[Place<T>],
    field: &mut [Vectors<T, C>],
) {
    let whole = partners.iter().map(|&partner| (partner, partner.sign()));
    let parts = parts.iter().map(|&(partner, part)| (partner, partner.sign() * part.share()));
    whole.chain(parts).for_each(|(partner, weight)| {
        let weight = T::of(weight);
        for source in &sources[stations.places(partner.station())] {
            if columns.push(source, weight) {
                columns.send(targets, field);
            }
        }
    });
    if columns.n > 0 {
        columns.send(targets, field);
    }
}

/// Adds the field of sources side by side at a place.
#[inline(always)]
fn add<T: Number, const C: usize>(
    here: &Place<T>,
    from: [&[T; LANES]; 4],
    vectors: [[&[T; LANES]; 3]; C],
    sums: &mut [[[T; LANES]; 3]; C],
) {
    let [x, y, z, softening] = from;
    for lane in 0..LANES {
        let r = [x[lane] - here[0], y[lane] - here[1], z[lane] - here[2]];
        let r2 = r[0] * r[0] + r[1] * r[1] + r[2] * r[2];
        let under = r2 * (T::of(PI) * r2 + (here[3] + softening[lane]));
        let by = T::of(1.0) / under;
        for channel in 0..C {
            let [u, v, w] = vectors[channel];
            let along = (r[0] * u[lane] + r[1] * v[lane] + r[2] * w[lane]) * by;
            for axis in 0..3 {
                sums[channel][axis][lane] += along * r[axis];
            }
        }
    }
}
