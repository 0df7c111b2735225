//! The fast multipole method on the links of a map.
//!
//! Under a link everything sees everything, no cosine changes its sign and nothing is between, so
//! the exchange of elements far from each other is smooth, and
//!
//! K_ij = -(n_i·r)(n_j·r) / (r² (π r² + c (A_i + A_j))),  r = x_j - x_i,
//!
//! can be taken at a few places instead: a node of many elements has a grid of Chebyshev nodes over
//! the box of their places ([`grid`]), which gather the vectors n_j A_j b_j ([`chebyshev`]). What
//! is farther away needs fewer places: there are grids of falling order, down to one place. The
//! elements of a node and each of its grids are a [`station`]; two stations are joined by the same
//! sum as elements are ([`translate`]), and which ones that is right for says [`walk`].
//!
//! No table of translations: the matrix between two places is the product r rᵀ times a number, so
//! that to compute it takes less than to read it, and boxes may be of any size, level and shape.
//! Source: Goradia et al. 2007 §5.3; Fong and Darve 2009, "The black-box fast multipole method".

pub(crate) mod bounds;
pub(crate) mod chebyshev;
pub(crate) mod grid;
pub(crate) mod station;
pub(crate) mod translate;
pub(crate) mod walk;
