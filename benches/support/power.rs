//! How a figure grows with another: least squares through the logarithms.

/// y = factor · x^exponent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Growth {
    pub(crate) factor: f64,
    pub(crate) exponent: f64,
}

impl Growth {
    /// Fits positive points; `None` where fewer than two x differ.
    pub(crate) fn fit(points: &[(f64, f64)]) -> Option<Growth> {
        let logs: Vec<(f64, f64)> = points.iter().map(|p| (p.0.ln(), p.1.ln())).collect();
        let mean =
            |of: fn(&(f64, f64)) -> f64| logs.iter().map(of).sum::<f64>() / logs.len() as f64;
        let (x, y) = (mean(|p| p.0), mean(|p| p.1));
        let spread: f64 = logs.iter().map(|p| (p.0 - x) * (p.0 - x)).sum();
        let common: f64 = logs.iter().map(|p| (p.0 - x) * (p.1 - y)).sum();
        // Without points the means are NaN, and so is this.
        if spread.is_nan() || spread < 1e-9 {
            return None;
        }
        let exponent = common / spread;
        Some(Growth { factor: (y - exponent * x).exp(), exponent })
    }

    /// Gives y at a place.
    pub(crate) fn at(&self, x: f64) -> f64 {
        self.factor * x.powf(self.exponent)
    }
}
