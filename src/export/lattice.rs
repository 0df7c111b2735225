//! The lattice of a LAS that holds all scans, and the way onto it.

use pvmap_geometry::Frame;
use pvmap_vmap::{OctreeView, Source};

/// Steps that a lattice of our own has along the cube's side at the most: 30 bits of the 32.
const MOST_STEPS: f64 = 1e9;

/// A lattice for all points, and the way of each source onto it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Lattice {
    pub(super) scale: [f64; 3],
    pub(super) offset: [f64; 3],
    /// By source: output X = stored X + this; none where coordinates are rounded to steps.
    pub(super) shifts: Option<Vec<[i64; 3]>>,
}

impl Lattice {
    /// Takes the lattice of the scans where they have one, else makes one fine enough.
    pub(super) fn of(octree: &OctreeView<'_>) -> Lattice {
        let sources = octree.sources();
        match octree.frame().frame {
            Frame::Lattice { scale, offset, min, extent } => {
                let base = [0, 1, 2].map(|i| match sources.len() {
                    0 | 1 => 0,
                    _ => base(min[i], extent / scale[i]),
                });
                let shift = |s: &Source| [0, 1, 2].map(|i| s.shift[i].saturating_sub(base[i]));
                Lattice {
                    scale,
                    offset: [0, 1, 2].map(|i| offset[i] + base[i] as f64 * scale[i]),
                    shifts: Some(sources.iter().map(shift).collect()),
                }
            }
            Frame::World { min, extent } => {
                let lattice = Lattice::of_lattices(sources, min, extent);
                lattice.unwrap_or_else(|| Lattice::decimal(min, extent))
            }
        }
    }

    /// Takes the finest steps of scans that all have a lattice; none where the points do not fit.
    fn of_lattices(sources: &[Source], min: [f64; 3], extent: f64) -> Option<Lattice> {
        let first = sources.first().filter(|_| sources.iter().all(|s| s.format != 3))?;
        let scale = [0, 1, 2].map(|i| sources.iter().map(|s| s.scale[i]).fold(f64::MAX, f64::min));
        let fits = (0..3).all(|i| {
            let steps = |x: f64| (x - first.offset[i]) / scale[i];
            steps(min[i]) >= -2e9 && steps(min[i] + extent) <= 2e9
        });
        fits.then_some(Lattice { scale, offset: first.offset, shifts: None })
    }

    /// Makes one of the finest decimal steps that the points fit in.
    fn decimal(min: [f64; 3], extent: f64) -> Lattice {
        // Of a single point any step will do; f64 ends long before 1e-15 of a kilometre.
        let n_decimals = match extent {
            e if e > 0.0 => (MOST_STEPS / e).log10().floor().clamp(-300.0, 15.0),
            _ => 6.0,
        };
        let scale = match n_decimals as i32 {
            // 1/1000 is nearer to 0.001 than any product of tenths.
            n if n >= 0 => 1.0 / 10f64.powi(n),
            n => 10f64.powi(-n),
        };
        Lattice { scale: [scale; 3], offset: min.map(f64::floor), shifts: None }
    }
}

/// Gives the step that becomes 0: 0 itself where all steps fit i32 then, else the middle.
fn base(min: i64, n_steps: f64) -> i64 {
    let max = min.saturating_add(n_steps.ceil() as i64);
    let fits = min >= i64::from(i32::MIN) && max <= i64::from(i32::MAX);
    if fits { 0 } else { min.saturating_add((n_steps / 2.0) as i64) }
}

/// Moves steps; none where one has no room.
pub(super) fn shift_all(steps: &mut [[i32; 3]], shift: [i64; 3]) -> Option<()> {
    for place in steps {
        for i in 0..3 {
            place[i] = i32::try_from(i64::from(place[i]).checked_add(shift[i])?).ok()?;
        }
    }
    Some(())
}

/// Gives world coordinates by the two operations of the LAS standard.
pub(super) fn world(steps: &[[i32; 3]], scale: [f64; 3], offset: [f64; 3]) -> Vec<[f64; 3]> {
    let along = |x: &[i32; 3], i: usize| f64::from(x[i]) * scale[i] + offset[i];
    steps.iter().map(|x| [along(x, 0), along(x, 1), along(x, 2)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lattice_of_our_own_has_decimal_steps_that_fit() {
        for (extent, scale) in
            [(10.0, 1e-8), (9.99, 1e-8), (0.3, 1e-9), (5e5, 1e-3), (3e10, 100.0), (0.0, 1e-6)]
        {
            let found = Lattice::decimal([-3.5, 7.0, 0.1], extent);
            assert!((found.scale[0] / scale - 1.0).abs() < 1e-12, "{extent}: {:?}", found.scale);
            assert_eq!(found.offset, [-4.0, 7.0, 0.0]);
        }
        assert_eq!(Lattice::decimal([0.0; 3], 5e5).scale, [0.001; 3]);
    }

    #[test]
    fn steps_that_leave_i32_are_counted_from_the_middle() {
        assert_eq!(base(-5, 1e6), 0);
        assert_eq!(base(i64::from(i32::MAX) - 10, 20.0), i64::from(i32::MAX));
        assert_eq!(base(-(1 << 40), 4e9), -(1 << 40) + 2_000_000_000);
        let mut steps = vec![[i32::MAX, 0, 5]];
        assert_eq!(shift_all(&mut steps, [1, 0, 0]), None);
        assert_eq!(shift_all(&mut steps, [-1, 7, 0]), Some(()));
        assert_eq!(steps, [[i32::MAX - 1, 7, 5]]);
    }
}
