//! The exchange of light between all elements that see each other, as an operator.

use std::path::Path;
use std::sync::Arc;

use pvmap_vmap::Fraction;
use pvmap_vmap::fraction::SEGMENTS;
use rayon::prelude::*;

use crate::element::Elements;
use crate::error::LightError;
use crate::fmm::bounds::Bounds;
use crate::fmm::chebyshev::MAX_ORDER;
use crate::fmm::grid::{Grid, Grids, error_of};
use crate::fmm::station::{MAX_STATIONS, Partner, Stations, of_elements};
use crate::fmm::walk::{Pairs, Walk};
use crate::hierarchy::{Hierarchy, Links, Span, Subtree};
use crate::kernel::Kernel;
use crate::lists::{Lengths, Lists};
use crate::near_field::{Correction, Corrections};
use crate::passes::Passes;
use crate::precision::Precision;
use crate::sum::sum;

/// What is not 0 only for pairs of elements that see each other: (G b)_i = Σ_j G_ij b_j, the flux
/// that arrives at i where j has the exitance b_j.
///
/// G is symmetric: links are applied both ways, with the same numbers. Sums are made in an order
/// that depends on the scene alone, so results have the same bits for any number of threads.
#[derive(Debug)]
pub struct Exchange {
    pub(crate) elements: Arc<Elements>,
    pub(crate) hierarchy: Hierarchy,
    pub(crate) kernel: Kernel,
    /// For each node, the elements that its own exchange light with one by one.
    pub(crate) near: Lists<Span>,
    pub(crate) far: Option<Far>,
    pub(crate) precision: Precision,
    /// For each node, the elements of which its own see a part, one by one.
    pub(crate) near_parts: Lists<(Span, Part)>,
    /// What near pairs exchange beyond what their middles say.
    pub(crate) corrections: Corrections,
}

/// Which part of what two nodes exchange is added, in sixteenths, -16…16: what they see of each
/// other, less what links say.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub(crate) struct Part(i8);

impl Part {
    /// Gives it, -1…1.
    #[inline]
    pub(crate) fn share(self) -> f64 {
        f64::from(self.0) / f64::from(SEGMENTS)
    }
}

/// Pairs of nodes that see a part of each other, looked at together.
const FRACTIONS_AT_ONCE: usize = 1 << 12;

/// What the multipole method adds.
#[derive(Debug)]
pub(crate) struct Far {
    order: usize,
    pub(crate) grids: Grids,
    pub(crate) stations: Stations,
    /// For each station, those that it exchanges light with as a whole.
    pub(crate) lists: Lists<Partner>,
    /// For each station, those of which it sees a part.
    pub(crate) parts: Lists<(Partner, Part)>,
}

/// Memory for lists and the pairs they are made of, and the folder for them if there are more; none
/// holds them all.
pub(crate) type Spill<'a> = Option<(u64, &'a Path)>;

/// Ranges of elements all pairs of which an operator takes, from `sources` to `targets`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Interaction {
    /// Where light arrives.
    pub targets: Span,
    /// Where it comes from.
    pub sources: Span,
    /// Whether it is taken by grids instead of element by element.
    pub is_far: bool,
}

/// How much there is to compute and to hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ExchangeStats {
    /// Ranges of elements that are taken one by one, over all nodes.
    pub n_near_ranges: usize,
    /// Pairs of elements that are taken one by one, both ways.
    pub n_near_pairs: u64,
    /// Pairs of nodes that are taken as wholes, both ways.
    pub n_far: usize,
    /// Pairs of places by which these are taken.
    pub n_far_pairs: u64,
    /// Pairs of nodes that see a part of each other, both ways.
    pub n_parts: usize,
    /// Grids of nodes.
    pub n_grids: usize,
    /// Places of all grids.
    pub n_places: usize,
    /// Memory of lists, elements and grids.
    pub held_bytes: usize,
}

impl Exchange {
    /// Takes every pair of elements under the links by itself: the oracle of [`Self::multipole`].
    ///
    /// Memory: 8 bytes for each range of elements on the list of a node (12 for those that are seen
    /// in part), 64 an element, 40 a node. While it is made 8 for each pair of nodes, too.
    /// Time: proportional to the pairs.
    ///
    /// # Errors
    /// Where the leaves of the tree are not the elements, or a link joins what it may not.
    pub fn direct(
        elements: impl Into<Arc<Elements>>,
        hierarchy: Hierarchy,
        links: &(impl Links + ?Sized),
        kernel: Kernel,
    ) -> Result<Exchange, LightError> {
        Exchange::within(elements.into(), hierarchy, links, kernel, (None, None))
    }

    /// Makes an exchange of some order, or without grids.
    pub(crate) fn within(
        elements: Arc<Elements>,
        hierarchy: Hierarchy,
        links: &(impl Links + ?Sized),
        kernel: Kernel,
        (order, spill): (Option<usize>, Spill<'_>),
    ) -> Result<Exchange, LightError> {
        if let Some(order) = order {
            return Exchange::by_grids(elements, hierarchy, links, kernel, (order, spill));
        }
        let bounds = Bounds::of_all(check_count(&elements, &hierarchy)?, &hierarchy);
        let grids = Grids::none(&hierarchy);
        let walk = walk(&hierarchy, &bounds, &grids, kernel, 0.0, links);
        let (near, _) = lists(&walk, hierarchy.n_nodes() as usize, links, spill)?;
        Exchange {
            elements,
            hierarchy,
            kernel,
            near,
            far: None,
            precision: Precision::Double { places: Vec::new() },
            near_parts: Lists::of(0, std::iter::empty)?,
            corrections: Corrections::default(),
        }
        .with_fractions(links, &bounds)
    }

    /// Takes nodes that are far apart by grids of an order 1…7.
    ///
    /// A node of more elements than that has a full grid of p³ places, p² over a plane that is
    /// square to the axes; other nodes and, for what is far away, the same ones have grids of lower
    /// order. Up to order 5 single precision is enough.
    ///
    /// Memory beyond that of [`Self::direct`]: 4 bytes for each partner on the list of a grid, 72 a
    /// grid, 20 a node, and 16 a place and 48 an element in single, 32 each in double precision;
    /// while it is applied 24 or 48 more a place and an element.
    ///
    /// # Errors
    /// Those of [`Self::direct`], or where there is no such order.
    pub fn multipole(
        elements: impl Into<Arc<Elements>>,
        hierarchy: Hierarchy,
        links: &(impl Links + ?Sized),
        kernel: Kernel,
        order: usize,
    ) -> Result<Exchange, LightError> {
        Exchange::by_grids(elements.into(), hierarchy, links, kernel, (order, None))
    }

    fn by_grids(
        elements: Arc<Elements>,
        hierarchy: Hierarchy,
        links: &(impl Links + ?Sized),
        kernel: Kernel,
        (order, spill): (usize, Spill<'_>),
    ) -> Result<Exchange, LightError> {
        if !(1..=MAX_ORDER).contains(&order) {
            let (what, range) = ("the order", "1 to 7");
            return Err(LightError::Setting { what, value: order as f64, range });
        }
        let bounds = Bounds::of_all(check_count(&elements, &hierarchy)?, &hierarchy);
        let grids = Grids::of(&elements, &hierarchy, &bounds, order);
        let n_stations = u64::from(hierarchy.n_nodes()) + grids.n_grids() as u64;
        let n_places = (elements.len() + grids.n_places()) as u64;
        if n_stations > MAX_STATIONS || n_places > u64::from(u32::MAX) {
            let what = "is one of too many for the multipole method";
            return Err(LightError::Tree { node: hierarchy.n_nodes() - 1, what });
        }
        let stations = Stations::of(&hierarchy, &grids);
        let walk = walk(&hierarchy, &bounds, &grids, kernel, error_of(order), links);
        let c = kernel.regularisation();
        let places = |node: u32| {
            let softening = c * bounds[node as usize].area().0;
            grids.of_node(node).iter().flat_map(Grid::places).map(move |x| (x, softening))
        };
        let of_grids = || (0..hierarchy.n_nodes()).flat_map(places);
        let (lists, precision) = rayon::join(
            || lists(&walk, stations.len(), links, spill),
            || Precision::of(&elements, (order, c), of_grids()),
        );
        let (near, lists) = lists?;
        let parts = Lists::of(0, std::iter::empty)?;
        let far = Some(Far { order, grids, stations, lists, parts });
        Exchange {
            elements,
            hierarchy,
            kernel,
            near,
            far,
            precision,
            near_parts: Lists::of(0, std::iter::empty)?,
            corrections: Corrections::default(),
        }
        .with_fractions(links, &bounds)
    }
}

impl Exchange {
    /// Adds the pairs that see a part of each other, as wholes where links would be.
    fn with_fractions(
        mut self,
        links: &(impl Links + ?Sized),
        bounds: &[Bounds],
    ) -> Result<Exchange, LightError> {
        let fractions = links.fractions()?;
        let tree = &self.hierarchy;
        let none = Grids::none(tree);
        let (grids, error) = match &self.far {
            Some(far) => (&far.grids, error_of(far.order)),
            None => (&none, 0.0),
        };
        let regularisation = self.kernel.regularisation();
        // What sees a part need not face each other everywhere.
        let all_face = false;
        let walk = Walk { hierarchy: tree, bounds, grids, regularisation, error, all_face };
        let some = |some: &[Fraction]| {
            let (mut near, mut far) = (Vec::new(), Vec::new());
            for &Fraction { a, b, n_free } in some {
                let pairs = walk.pairs((a, b))?;
                let linked = if self.is_linked(a, tree.node(b).elements.0) { SEGMENTS } else { 0 };
                // Both are 0 to 16.
                let part = Part(n_free as i8 - linked as i8);
                near.extend(pairs.near(tree).map(|(node, span)| (node, (span, part))));
                far.extend(pairs.far().map(|(station, partner)| (station, (partner, part))));
            }
            Ok((near, far))
        };
        let found = fractions.par_chunks(FRACTIONS_AT_ONCE).map(some);
        let found = found.collect::<Result<Vec<_>, LightError>>()?;
        let near = || found.iter().flat_map(|some| some.0.iter().copied());
        let far = || found.iter().flat_map(|some| some.1.iter().copied());
        self.near_parts = Lists::of(bounds.len(), near)?;
        if let Some(joined) = &mut self.far {
            joined.parts = Lists::of(joined.stations.len(), far)?;
        }
        Ok(self)
    }

    /// Takes some pairs of elements, each once, by quadrature instead of by their middles.
    pub(crate) fn with_near_field(mut self, found: &[Correction]) -> Exchange {
        self.corrections = Corrections::of(self.elements.len(), found);
        self
    }

    /// Says whether links let the first element of a node see another one.
    fn is_linked(&self, node: u32, element: u32) -> bool {
        let holds = |span: Option<Span>| span.is_some_and(|span| span.0 <= element);
        self.hierarchy.path(self.hierarchy.first_leaf(node)).any(|above| {
            let near = self.near.of_node(above);
            holds(near.get(near.partition_point(|span| span.1 <= element)).copied())
                || self.lists(above).any(|(far, list)| {
                    let end = |&partner: &Partner| self.elements_of(far, partner).1;
                    let at = list.partition_point(|partner| end(partner) <= element);
                    holds(list.get(at).map(|&partner| self.elements_of(far, partner)))
                })
        })
    }

    /// Walks the lists of a node's stations.
    fn lists(&self, node: u32) -> impl Iterator<Item = (&Far, &[Partner])> {
        self.stations(node).map(|(far, station)| (far, far.lists.of_node(station)))
    }

    fn stations(&self, node: u32) -> impl Iterator<Item = (&Far, u32)> {
        self.far.iter().flat_map(move |far| {
            let first = of_elements(&far.grids, node);
            let stations = first..=first + far.grids.of_node(node).len() as u32;
            stations.map(move |station| (far, station))
        })
    }

    /// Walks the elements of the nodes that a node exchanges light with as a whole.
    fn partners(&self, node: u32) -> impl Iterator<Item = Span> + '_ {
        self.lists(node)
            .flat_map(|(far, list)| list.iter().map(|&partner| self.elements_of(far, partner)))
    }

    /// Walks the elements of the nodes of which a node sees a part as a whole.
    fn partners_in_part(&self, node: u32) -> impl Iterator<Item = (Span, Part)> + '_ {
        self.stations(node).flat_map(|(far, station)| {
            let list = far.parts.of_node(station).iter();
            list.map(|&(partner, part)| (self.elements_of(far, partner), part))
        })
    }

    fn elements_of(&self, far: &Far, partner: Partner) -> Span {
        self.hierarchy.node(far.stations.node(partner.station())).elements
    }

    /// Counts the pairs of elements that are taken by quadrature.
    pub fn n_near_field(&self) -> u64 {
        self.corrections.n_pairs()
    }

    /// Gives the elements.
    pub fn elements(&self) -> &Elements {
        &self.elements
    }

    /// Gives the order of the grids; none of the direct operator.
    pub fn order(&self) -> Option<usize> {
        self.far.as_ref().map(|far| far.order)
    }

    /// Gives G b: for each element the flux that arrives where element j has exitance `b[j]`.
    ///
    /// Runs on the current rayon pool.
    ///
    /// # Errors
    /// Where there are not as many values as elements.
    pub fn apply(&self, b: &[f64]) -> Result<Vec<f64>, LightError> {
        let [flux] = self.apply_to([b])?;
        Ok(flux)
    }

    /// Gives G b for each of some b, to the bit as one by one; three take little longer than one.
    ///
    /// # Errors
    /// Those of [`Exchange::apply`].
    pub fn apply_each(&self, b: &[&[f64]]) -> Result<Vec<Vec<f64>>, LightError> {
        let mut flux = Vec::with_capacity(b.len());
        for three in b.chunks(3) {
            match *three {
                [x, y, z] => flux.extend(self.apply_to([x, y, z])?),
                [x, y] => flux.extend(self.apply_to([x, y, y])?.into_iter().take(2)),
                _ => {
                    flux.extend(three.iter().map(|b| self.apply(b)).collect::<Result<Vec<_>, _>>()?)
                }
            }
        }
        Ok(flux)
    }

    fn apply_to<const C: usize>(&self, b: [&[f64]; C]) -> Result<[Vec<f64>; C], LightError> {
        let expected = self.elements.len();
        if let Some(found) = b.iter().map(|b| b.len()).find(|&found| found != expected) {
            return Err(LightError::Count { what: "exitance", found, expected });
        }
        Ok(match &self.precision {
            Precision::Single { columns, places, unit } => {
                Passes::new(self, (columns, places, *unit), b).run()
            }
            Precision::Double { places } => {
                Passes::new(self, (&self.elements.columns, places, 1.0), b).run()
            }
        })
    }

    /// Says how far the grids are off at some elements: the mean difference of what arrives there,
    /// `flux` = G b, from the sum pair by pair, an area, as a share of the mean. 0 without grids.
    pub(crate) fn error_at(&self, elements: &[u32], b: &[f64], flux: &[f64]) -> f64 {
        if self.far.is_none() {
            return 0.0;
        }
        let one = |&id: &u32| {
            let (exact, area) = (self.flux_at(id, b), self.elements.areas()[id as usize]);
            ((flux[id as usize] - exact).abs() / area, exact / area)
        };
        let rows: Vec<(f64, f64)> = elements.par_iter().map(one).collect();
        let (off, all) = (sum(rows.iter().map(|row| row.0)), sum(rows.iter().map(|row| row.1)));
        if all > 0.0 { off / all } else { 0.0 }
    }

    /// Lists the elements that links let an element see, in part or whole.
    pub(crate) fn sources_of(&self, element: u32) -> Vec<Span> {
        let mut spans = Vec::new();
        for node in self.hierarchy.path(self.hierarchy.leaf_of(element)) {
            spans.extend_from_slice(self.near.of_node(node));
            spans.extend(self.partners(node));
        }
        spans
    }

    /// Gives the exchange of two elements that see each other.
    pub(crate) fn of_pair(&self, i: usize, j: usize) -> f64 {
        self.kernel.exchange(&self.elements, i, j)
    }

    /// Gives the flux that arrives at an element, pair by pair, also what grids bring.
    pub(crate) fn flux_at(&self, element: u32, b: &[f64]) -> f64 {
        let Exchange { elements, hierarchy, kernel, near, near_parts, corrections, .. } = self;
        let (leaf, i) = (hierarchy.leaf_of(element), element as usize);
        let from = |node| {
            let far: Vec<Span> = self.partners(node).collect();
            let parts: Vec<(Span, Part)> = self.partners_in_part(node).collect();
            kernel.row(elements, i, (near.of_node(node), near_parts.of_node(node)), b)
                + kernel.row(elements, i, (&far, &parts), b)
        };
        hierarchy.path(leaf).map(from).sum::<f64>() + corrections.flux(i, b)
    }

    /// Walks all that is taken, ranges of elements with ranges of elements, both ways.
    pub fn interactions(&self) -> impl Iterator<Item = Interaction> + '_ {
        let elements = |node| self.hierarchy.node(node).elements;
        (0..self.hierarchy.n_nodes()).flat_map(move |node| {
            let targets = elements(node);
            let near = self.near.of_node(node).iter();
            let near = near.map(move |&sources| Interaction { targets, sources, is_far: false });
            let far = self.partners(node);
            near.chain(far.map(move |sources| Interaction { targets, sources, is_far: true }))
        })
    }

    /// Counts what there is to compute and to hold.
    pub fn stats(&self) -> ExchangeStats {
        let size = |span: Span| u64::from(span.1 - span.0);
        let near = |node| {
            let sources = self.near.of_node(node).iter().map(|&span| size(span)).sum::<u64>();
            size(self.hierarchy.node(node).elements) * sources
        };
        let mut stats = ExchangeStats {
            n_near_ranges: self.near.n_entries(),
            n_near_pairs: (0..self.hierarchy.n_nodes()).map(near).sum(),
            n_parts: self.near_parts.n_entries(),
            held_bytes: self.near.bytes()
                + self.near_parts.bytes()
                + self.corrections.held_bytes()
                + self.elements.len() * 8 * size_of::<f64>()
                + self.precision.held_bytes()
                + self.hierarchy.n_nodes() as usize * size_of::<Subtree>(),
            ..ExchangeStats::default()
        };
        if let Some(far) = &self.far {
            stats.n_far = far.lists.n_entries();
            stats.n_parts += far.parts.n_entries();
            let size = |station| far.stations.places(station).len() as u64;
            for station in 0..far.stations.len() as u32 {
                let partners = far.lists.of_node(station).iter();
                stats.n_far_pairs +=
                    size(station) * partners.map(|partner| size(partner.station())).sum::<u64>();
            }
            stats.n_grids = far.grids.n_grids();
            stats.n_places = far.grids.n_places();
            stats.held_bytes += far.lists.bytes()
                + far.parts.bytes()
                + far.grids.held_bytes()
                + far.stations.held_bytes();
        }
        stats
    }
}

/// Checks that each leaf is an element.
fn check_count<'a>(
    elements: &'a Elements,
    hierarchy: &Hierarchy,
) -> Result<&'a Elements, LightError> {
    let (found, expected) = (elements.len(), hierarchy.n_elements());
    let what = "elements of the tree";
    (found == expected).then_some(elements).ok_or(LightError::Count { what, found, expected })
}

fn walk<'w>(
    hierarchy: &'w Hierarchy,
    bounds: &'w [Bounds],
    grids: &'w Grids,
    kernel: Kernel,
    error: f64,
    links: &(impl Links + ?Sized),
) -> Walk<'w> {
    let (regularisation, all_face) = (kernel.regularisation(), links.all_face());
    Walk { hierarchy, bounds, grids, regularisation, error, all_face }
}

/// Makes the lists of nodes and of stations: of all pairs at once where there is room, else in
/// files of the folder, the pairs found twice instead of held.
fn lists(
    walk: &Walk<'_>,
    n_stations: usize,
    links: &(impl Links + ?Sized),
    spill: Spill<'_>,
) -> Result<(Lists<Span>, Lists<Partner>), LightError> {
    let tree = walk.hierarchy;
    let n_nodes = tree.n_nodes() as usize;
    let limit_bytes = spill.map_or(u64::MAX, |(bytes, _)| bytes);
    if let Some(found) = walk.all(links, limit_bytes)? {
        let near = || Lists::of(n_nodes, || found.iter().flat_map(|pairs| pairs.near(tree)));
        let far = || Lists::of(n_stations, || found.iter().flat_map(Pairs::far));
        let (near, far) = rayon::join(|| near()?.merged(None), far);
        return Ok((near?, far?));
    }
    let folder = spill.map(|(_, folder)| folder);
    let (mut near, mut far) = (Lengths::new(n_nodes), Lengths::new(n_stations));
    walk.each(links, |pairs| {
        pairs.near(tree).for_each(|(node, _)| near.add(node));
        pairs.far().for_each(|(station, _)| far.add(station));
    })?;
    let (mut near, mut far) = (near.fill(folder)?, far.fill(folder)?);
    walk.each(links, |pairs| {
        pairs.near(tree).for_each(|(node, span)| near.put(node, span));
        pairs.far().for_each(|(station, partner)| far.put(station, partner));
    })?;
    Ok((near.done().merged(folder)?, far.done()))
}
