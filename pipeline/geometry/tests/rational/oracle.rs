//! [V-1]…[V-3] as the text says them, with fractions.

use num_bigint::BigInt;
use num_rational::Ratio;
use pvmap_geometry::disc::{Disc, Profile, blocks, faces_both};

type Q = Ratio<BigInt>;

fn q(v: i128) -> Q {
    Q::from_integer(BigInt::from(v))
}

fn dot(a: &[Q; 3], b: &[Q; 3]) -> Q {
    &a[0] * &b[0] + &a[1] * &b[1] + &a[2] * &b[2]
}

pub(crate) fn vector(v: [i32; 3]) -> [Q; 3] {
    v.map(|c| q(c.into()))
}

pub(crate) fn minus(a: &[Q; 3], b: &[Q; 3]) -> [Q; 3] {
    [0, 1, 2].map(|i| &a[i] - &b[i])
}

/// [V-2] as printed.
pub(crate) fn blocks_by_fractions(profile: Profile, a: &Disc, b: &Disc, k: &Disc) -> bool {
    let (ca, cb, ck) = (vector(a.centroid), vector(b.centroid), vector(k.centroid));
    let d = minus(&cb, &ca);
    let n = k.normal.map(|c| q(c.into()));
    let (s, h) = (dot(&n, &d), dot(&n, &minus(&ck, &ca)));
    if s == q(0) {
        return false;
    }
    let t = h / s;
    if t <= q(0) || t >= q(1) {
        return false;
    }
    let x = [0, 1, 2].map(|i| &ca[i] + &t * &d[i]);
    let within = |v: &[Q; 3]| dot(v, v);
    let on_disc = within(&minus(&x, &ck)) <= q(k.radius2.into());
    let (low, high) = (vector(k.limit.min), vector(k.limit.max));
    let on_patch = || {
        (0..3).all(|i| low[i] <= x[i] && x[i] <= high[i])
            && within(&minus(&x, &ca)) > q(a.radius2.into())
            && within(&minus(&x, &cb)) > q(b.radius2.into())
    };
    let in_rect = || {
        (0..2).all(|i| {
            // An axis stands for one of length 1.
            let axis = k.rect.axes[i].map(|c| q(c.into()) / q(1 << 14));
            let along = dot(&axis, &minus(&x, &ck));
            q(k.rect.low[i].into()) <= along && along <= q(k.rect.high[i].into())
        })
    };
    on_disc
        && match profile {
            Profile::Paper => clip(&ca, &d, &low, &high),
            Profile::Patch => on_patch(),
            Profile::Oriented => on_patch() && in_rect(),
        }
}

/// Does a + t·d, 0 ≤ t ≤ 1, meet the closed box? By clipping the parameter interval.
pub(crate) fn clip(a: &[Q; 3], d: &[Q; 3], low: &[Q; 3], high: &[Q; 3]) -> bool {
    let (mut first, mut last) = (q(0), q(1));
    for i in 0..3 {
        if d[i] == q(0) {
            if a[i] < low[i] || a[i] > high[i] {
                return false;
            }
            continue;
        }
        let (mut near, mut far) = ((&low[i] - &a[i]) / &d[i], (&high[i] - &a[i]) / &d[i]);
        if near > far {
            std::mem::swap(&mut near, &mut far);
        }
        first = first.max(near);
        last = last.min(far);
    }
    first <= last
}

fn faces_by_fractions(a: &Disc, b: &Disc) -> bool {
    let d = minus(&vector(b.centroid), &vector(a.centroid));
    let looks = |k: &Disc, sign: i128| {
        let n = k.normal.map(|c| q(c.into()));
        let s = dot(&n, &d) * q(sign);
        k.normal == [0; 3] || s > q(0) || (k.two_sided && s != q(0))
    };
    d != vector([0; 3]) && looks(a, 1) && looks(b, -1)
}

/// Holds verdicts on three discs against fractions, and against themselves from the other end.
pub(crate) fn check(a: &Disc, b: &Disc, k: &Disc) {
    for profile in [Profile::Paper, Profile::Patch, Profile::Oriented] {
        let got = blocks(profile, a, b, k);
        assert_eq!(got, blocks_by_fractions(profile, a, b, k), "{profile:?} {a:?} {b:?} {k:?}");
        assert_eq!(got, blocks(profile, b, a, k), "asymmetric {profile:?} {a:?} {b:?} {k:?}");
    }
    // It takes places away and adds none.
    assert!(!blocks(Profile::Oriented, a, b, k) || blocks(Profile::Patch, a, b, k));
    assert_eq!(faces_both(a, b), faces_by_fractions(a, b), "{a:?} {b:?}");
    assert_eq!(faces_both(a, b), faces_both(b, a), "{a:?} {b:?}");
}
