//! Which elements are around a place, on the same surface.

use std::sync::Arc;

use crate::element::Elements;
use crate::fmm::bounds::Bounds;
use crate::hierarchy::Hierarchy;
use crate::vector::{add, beside, dot, norm, scale, sub};

/// Cosine between normals of one surface, at the least.
pub(crate) const SAME_SURFACE: f64 = 0.7;

/// Elements that are found by their places.
#[derive(Debug)]
pub(crate) struct Surroundings {
    elements: Arc<Elements>,
    hierarchy: Hierarchy,
    bounds: Vec<Bounds>,
}

impl Surroundings {
    pub(crate) fn new(elements: Arc<Elements>, hierarchy: Hierarchy) -> Surroundings {
        let bounds = Bounds::of_all(&elements, &hierarchy);
        Surroundings { elements, hierarchy, bounds }
    }

    /// Lists the elements within a radius of a place whose normals are like that of `of`, with
    /// weights that fall off with the distance, in their order.
    pub(crate) fn around(&self, place: [f64; 3], of: u32, radius: f64) -> Vec<(u32, f64)> {
        let normal = self.elements.get(of as usize).normal;
        let mut found = Vec::new();
        let mut open = vec![0];
        while let Some(node) = open.pop() {
            let of_node = &self.bounds[node as usize];
            if of_node.is_empty() || of_node.distance2_from(place) >= radius * radius {
                continue;
            }
            if !self.hierarchy.is_leaf(node) {
                open.extend(self.hierarchy.children(node));
                continue;
            }
            let id = self.hierarchy.node(node).elements.0;
            let element = self.elements.get(id as usize);
            let along = dot(element.normal, normal);
            let along = if element.two_sided { along.abs() } else { along };
            let apart = norm(sub(element.position, place)) / radius;
            if along >= SAME_SURFACE && apart < 1.0 {
                let near = 1.0 - apart * apart;
                found.push((id, near * near));
            }
        }
        found.sort_unstable_by_key(|one| one.0);
        found
    }

    /// Gives the normal at a place of an element, as that of the element is turned: of a plane
    /// laid through the normals within so many of its radii by least squares, so that a sphere is
    /// smooth however its elements lie. Their mean where they lie on a line.
    pub(crate) fn normal_at(&self, place: [f64; 3], of: u32, radii: f64) -> [f64; 3] {
        let element = self.elements.get(of as usize);
        let radius = radii * (element.area / std::f64::consts::PI).sqrt();
        let [u, v] = beside(element.normal);
        // Sums of weights times 1, x, y, x², x y, y², and of these three first times the normal.
        let mut sums = [0.0; 6];
        let mut normals = [[0.0; 3]; 3];
        for (id, weight) in self.around(place, of, radius) {
            let near = self.elements.get(id as usize);
            let is_turned = dot(near.normal, element.normal) < 0.0;
            let normal = if is_turned { scale(near.normal, -1.0) } else { near.normal };
            let off = sub(near.position, place);
            let (x, y) = (dot(off, u) / radius, dot(off, v) / radius);
            for (sum, by) in sums.iter_mut().zip([1.0, x, y, x * x, x * y, y * y]) {
                *sum += weight * by;
            }
            for (sum, by) in normals.iter_mut().zip([1.0, x, y]) {
                *sum = add(*sum, scale(normal, weight * by));
            }
        }
        let normal = at_middle(sums, normals);
        let length = norm(normal);
        // Beyond the last of some elements a plane may turn over.
        match length > 0.0 && dot(normal, element.normal) > 0.0 {
            true => scale(normal, 1.0 / length),
            false => element.normal,
        }
    }
}

/// Share of the determinant of a plane that is well laid below which there is none.
const LEAST_DETERMINANT: f64 = 1e-3;

/// Gives the value at (0, 0) of the plane through vectors at (x, y), by the sums of weights times
/// 1, x, y, x², x y, y² and of vectors times the first three of them.
fn at_middle([w, x, y, xx, xy, yy]: [f64; 6], [of_1, of_x, of_y]: [[f64; 3]; 3]) -> [f64; 3] {
    let minors = [xx * yy - xy * xy, xy * y - x * yy, x * xy - xx * y];
    let determinant = w * minors[0] + x * minors[1] + y * minors[2];
    if determinant <= LEAST_DETERMINANT * w * (xx + yy) * (xx + yy) {
        return of_1;
    }
    add(scale(of_1, minors[0]), add(scale(of_x, minors[1]), scale(of_y, minors[2])))
}
