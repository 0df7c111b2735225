//! Which elements are around a place, on the same surface.

use crate::element::Elements;
use crate::fmm::bounds::Bounds;
use crate::hierarchy::Hierarchy;
use crate::vector::{add, dot, norm, scale, sub};

/// Cosine between normals of one surface, at the least.
const SAME_SURFACE: f64 = 0.7;

/// Elements that are found by their places.
#[derive(Debug)]
pub(crate) struct Surroundings<'a> {
    elements: &'a Elements,
    hierarchy: Hierarchy,
    bounds: Vec<Bounds>,
}

impl<'a> Surroundings<'a> {
    pub(crate) fn new(elements: &'a Elements, hierarchy: Hierarchy) -> Surroundings<'a> {
        let bounds = Bounds::of_all(elements, &hierarchy);
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

    /// Gives the normal at a place of an element, averaged over so many of its radii.
    pub(crate) fn normal_at(&self, place: [f64; 3], of: u32, radii: f64) -> [f64; 3] {
        let element = self.elements.get(of as usize);
        let radius = radii * (element.area / std::f64::consts::PI).sqrt();
        let turn = |normal: [f64; 3]| {
            if dot(normal, element.normal) < 0.0 { scale(normal, -1.0) } else { normal }
        };
        let sum = self.around(place, of, radius).into_iter().fold([0.0; 3], |sum, (id, weight)| {
            add(sum, scale(turn(self.elements.get(id as usize).normal), weight))
        });
        let length = norm(sum);
        if length > 0.0 { scale(sum, 1.0 / length) } else { element.normal }
    }
}
