//! Vectors of three f64: the few operations the room needs.

/// A place or a direction in metres, or a direction of length 1.
pub(crate) type Vector = [f64; 3];

#[inline]
pub(crate) fn sub(a: Vector, b: Vector) -> Vector {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// Gives a + s·b.
#[inline]
pub(crate) fn add_scaled(a: Vector, s: f64, b: Vector) -> Vector {
    [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]
}

#[inline]
pub(crate) fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Gives a × b. Swapping a and b negates it exactly: each product is rounded on its own.
#[inline]
pub(crate) fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline]
pub(crate) fn length(a: Vector) -> f64 {
    dot(a, a).sqrt()
}

#[inline]
pub(crate) fn distance2(a: Vector, b: Vector) -> f64 {
    let d = sub(a, b);
    dot(d, d)
}

/// Gives a at length 1; `a` is not zero.
#[inline]
pub(crate) fn unit(a: Vector) -> Vector {
    let l = length(a);
    a.map(|v| v / l)
}
