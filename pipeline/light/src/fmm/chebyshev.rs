//! Interpolation at Chebyshev nodes.

/// The highest order.
pub(crate) const MAX_ORDER: usize = 7;

/// cos((2m + 1) π / 2p) for the orders p = 1…7. As decimals: the cosine of a platform's library may
/// differ in its last bit, and what is lit must not.
const NODES: [&[f64]; MAX_ORDER + 1] = [
    &[],
    &[0.0],
    &[0.707_106_781_186_547_5, -0.707_106_781_186_547_5],
    &[0.866_025_403_784_438_6, 0.0, -0.866_025_403_784_438_6],
    &[
        0.923_879_532_511_286_7,
        0.382_683_432_365_089_8,
        -0.382_683_432_365_089_8,
        -0.923_879_532_511_286_7,
    ],
    &[
        0.951_056_516_295_153_5,
        0.587_785_252_292_473_1,
        0.0,
        -0.587_785_252_292_473_1,
        -0.951_056_516_295_153_5,
    ],
    &[
        0.965_925_826_289_068_3,
        0.707_106_781_186_547_5,
        0.258_819_045_102_520_74,
        -0.258_819_045_102_520_74,
        -0.707_106_781_186_547_5,
        -0.965_925_826_289_068_3,
    ],
    &[
        0.974_927_912_181_823_6,
        0.781_831_482_468_029_8,
        0.433_883_739_117_558_1,
        0.0,
        -0.433_883_739_117_558_1,
        -0.781_831_482_468_029_8,
        -0.974_927_912_181_823_6,
    ],
];

/// Gives the nodes of an order, 1…7, within [-1, 1].
#[inline]
pub(crate) fn nodes(order: usize) -> &'static [f64] {
    NODES[order]
}

/// Gives T_0…T_6 at a place.
#[inline]
const fn polynomials(u: f64) -> [f64; MAX_ORDER] {
    let mut t = [1.0; MAX_ORDER];
    t[1] = u;
    let mut k = 2;
    while k < MAX_ORDER {
        t[k] = 2.0 * u * t[k - 1] - t[k - 2];
        k += 1;
    }
    t
}

/// T_0…T_6 at the nodes of each order.
const AT_NODES: [[[f64; MAX_ORDER]; MAX_ORDER]; MAX_ORDER + 1] = {
    let mut all = [[[0.0; MAX_ORDER]; MAX_ORDER]; MAX_ORDER + 1];
    let mut order = 1;
    while order <= MAX_ORDER {
        let mut m = 0;
        while m < order {
            all[order][m] = polynomials(NODES[order][m]);
            m += 1;
        }
        order += 1;
    }
    all
};

/// Gives the weight of each node of an order for a place u: S(t_m, u) = 1/p + 2/p Σ T_k(t_m) T_k(u)
/// over k = 1…p-1. A polynomial of degree p - 1 is the sum of its values at the nodes so weighted.
#[inline]
pub(crate) fn weights(order: usize, u: f64) -> [f64; MAX_ORDER] {
    let at_u = polynomials(u);
    let mut weights = [0.0; MAX_ORDER];
    for (weight, at_node) in weights.iter_mut().zip(&AT_NODES[order]).take(order) {
        let sum: f64 = (1..order).map(|k| at_node[k] * at_u[k]).sum();
        *weight = (1.0 + 2.0 * sum) / order as f64;
    }
    weights
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nodes_are_the_zeros_of_chebyshev_polynomials() {
        for order in 1..=MAX_ORDER {
            assert_eq!(nodes(order).len(), order);
            for (m, &t) in nodes(order).iter().enumerate() {
                let angle = (2 * m + 1) as f64 * std::f64::consts::PI / (2 * order) as f64;
                assert!((t - angle.cos()).abs() < 1e-15, "order {order}, node {m}");
            }
        }
    }

    #[test]
    fn an_order_reproduces_polynomials_of_a_lower_degree() {
        let polynomial = |degree: i32, u: f64| 3.0 - 2.0 * u + u.powi(degree);
        for order in 1..=MAX_ORDER {
            for u in [-1.0, -0.3, 0.0, 0.77, 1.0] {
                let w = weights(order, u);
                let sum: f64 = w.iter().sum();
                assert!((sum - 1.0).abs() < 1e-14, "order {order} at {u}: {sum}");
                for degree in 1..order as i32 {
                    let exact = polynomial(degree, u);
                    let terms = nodes(order).iter().zip(w);
                    let found: f64 = terms.map(|(&t, w)| w * polynomial(degree, t)).sum();
                    assert!((found - exact).abs() < 1e-13, "order {order}, degree {degree}");
                }
            }
        }
    }
}
