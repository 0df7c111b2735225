//! The leaf pairs of a small node pair, decided together: rows are the leaves under one node,
//! columns those under the other. Sheets are asked first ([`crate::sheets`]); what they leave
//! undecided, and what single leaves may block, goes through the leaf kernel.

use std::ops::Range;

use pvmap_geometry::{Box3, disc};
use pvmap_store::runs::Pair;
use pvmap_vmap::fraction::SEGMENTS;
use pvmap_vmap::{Fraction, Tree};

use crate::candidates::{self, Corridor, Depth, Kept, refine};
use crate::ends::Ends;
use crate::fractions::{self, N_ENDS};
use crate::kernel::{Blockers, Counts, Recent};
use crate::packets::{Packet, Shot, WIDTH, pack};
use crate::pairs::{Scene, Status};
use crate::screen::Screen;

/// Entries of a list of candidates that are opened to leaves before it is seen what is still open.
const PIECE: usize = 16;
/// Families whose leaves are loaded at once, to try a segment of any length: some 60 KiB.
const LOADED: usize = 128;
/// Children of a node at most.
const MAX_KIDS: usize = 8;
/// Discs of late memory pay where they block at least one in so many segments.
const LEAST_SHARE: u64 = 4;

/// Decides blocks on one thread; its buffers serve one block after another.
#[derive(Debug)]
pub struct BlockDecider<'a> {
    scene: Scene<'a>,
    blockers: Blockers,
    recent: Recent,
    /// Whether discs of late memory are tried first: they blocked enough the last time, or some
    /// were remembered since.
    recent_pays: bool,
    /// The rows and the columns of the block at hand.
    sides: [Box<Ends>; 2],
    /// For each row of the block, a bit a column that nothing has blocked yet.
    open: Vec<u64>,
    /// Of these, those that some sheet may block and did not decide.
    unsure: Vec<u64>,
    /// The segments that the kernel is asked about; `is_packed` if these are the open ones.
    packets: Vec<Packet>,
    is_packed: bool,
    screen: Screen,
    /// The families of the sheets that may block, and of those that left something undecided.
    sheets: Vec<u32>,
    undecided: Vec<Kept>,
    /// The sheet that blocked the most lately.
    last_sheet: u32,
    /// The PARTIAL pairs of the block.
    mixed: Vec<Pair>,
    /// Whether the segments at hand end off the centroids of their surfels.
    is_tried: bool,
    /// What it took so far.
    pub counts: Counts,
}

impl<'a> BlockDecider<'a> {
    /// Makes a decider of blocks.
    pub fn new(scene: Scene<'a>) -> BlockDecider<'a> {
        BlockDecider {
            scene,
            blockers: Blockers::default(),
            recent: Recent::default(),
            recent_pays: false,
            sides: [Box::new(Ends::NONE), Box::new(Ends::NONE)],
            open: Vec::new(),
            unsure: Vec::new(),
            packets: Vec::new(),
            is_packed: false,
            screen: Screen::default(),
            sheets: Vec::new(),
            undecided: Vec::new(),
            last_sheet: u32::MAX,
            mixed: Vec::new(),
            is_tried: false,
            counts: Counts::default(),
        }
    }

    /// Decides all leaf pairs under a pair at once, given a list that holds all its blockers.
    pub fn decide(
        &mut self,
        (a, b): Pair,
        candidates: &mut Vec<Kept>,
        list: Range<usize>,
        links: &mut Vec<Pair>,
    ) -> Status {
        self.load(a, b);
        self.mixed.clear();
        let whole = list.clone();
        let mut is_open = self.is_open();
        if is_open && self.recent_pays {
            self.try_recent();
            is_open = self.is_open();
        }
        let mut rest = list;
        while is_open && !rest.is_empty() {
            let piece = rest.start..rest.end.min(rest.start + PIECE);
            rest.start = piece.end;
            let start = candidates.len();
            self.refine(Depth::Sheets, candidates, piece);
            let end = candidates.len();
            self.try_sheets(&candidates[start..]);
            self.try_undecided(candidates);
            self.try_leaves(&candidates[start..end]);
            candidates.truncate(start);
            is_open = self.is_open();
        }
        let tree = self.scene.tree;
        let first = [a, b].map(|id| tree.nodes[id as usize].first_surfel);
        let block = Block { tree, first, open: &self.open };
        let status = block.fold(a, b, &mut self.mixed, links);
        if self.scene.tries.fractions {
            if tree.nodes[a as usize].is_leaf() && tree.nodes[b as usize].is_leaf() {
                self.mixed.push((a, b));
            }
            self.try_mixed((a, b), candidates, whole, links);
        }
        status
    }

    /// Tries a node pair by some of its leaves: gives how many of sixteen segments are free, given
    /// a list that holds all their blockers. [F-26]
    pub fn try_nodes(
        &mut self,
        (a, b): Pair,
        candidates: &mut Vec<Kept>,
        list: Range<usize>,
    ) -> u8 {
        let Scene { tree, discs, profile, .. } = self.scene;
        for (side, id) in self.sides.iter_mut().zip([a, b]) {
            let ends = fractions::representatives(tree, id).into_iter();
            let ends = ends.map(|surfel| (surfel, discs[surfel as usize].centroid));
            side.load_at(discs, ends, profile);
        }
        self.faces();
        self.shoot_all(candidates, list);
        n_bits(&self.open) as u8
    }

    /// Tries the leaf pairs of kids(A)×kids(B) for each (A, B) that is mixed, and notes what is not
    /// as the open segments of the block say. [F-25], [F-26]
    fn try_mixed(
        &mut self,
        block: Pair,
        candidates: &mut Vec<Kept>,
        list: Range<usize>,
        links: &mut Vec<Pair>,
    ) {
        if self.mixed.is_empty() {
            return;
        }
        let Scene { tree, discs, bounds, families, profile, .. } = self.scene;
        let by_centroids = std::mem::take(&mut self.open);
        let mixed = std::mem::take(&mut self.mixed);
        let sides = [block.0, block.1];
        let first = sides.map(|id| tree.nodes[id as usize].first_surfel);
        let ends = sides.map(|id| bounds[id as usize].centroids);
        let start = candidates.len();
        let corridor = Corridor::new(&ends[0], &ends[1]);
        self.counts.n_candidates += refine(families, &corridor, Depth::Leaves, candidates, list);
        let list = start..candidates.len();
        for &(a, b) in &mixed {
            let mut surfels = [[0; MAX_KIDS]; 2];
            let mut n = [0; 2];
            for (i, id) in [a, b].into_iter().enumerate() {
                let kids = tree.kids(id).map(|kid| &tree.nodes[kid as usize]);
                for kid in kids.filter(|kid| kid.is_leaf()) {
                    surfels[i][n[i]] = kid.first_surfel;
                    n[i] += 1;
                }
            }
            if n.contains(&0) {
                continue;
            }
            for i in 0..2 {
                let places = surfels[i][..n[i]].iter().flat_map(|&surfel| {
                    fractions::places(&tree.surfels[surfel as usize]).map(|place| (surfel, place))
                });
                self.sides[i].load_at(discs, places, profile);
            }
            let [rows, columns] = [&surfels[0][..n[0]], &surfels[1][..n[1]]];
            self.faces();
            for (i, &x) in rows.iter().enumerate() {
                let away = columns
                    .iter()
                    .enumerate()
                    .filter(|&(_, &y)| !disc::faces_both(&discs[x as usize], &discs[y as usize]));
                let closed = away.fold(0, |closed, (j, _)| closed | lanes_of(j));
                self.open[N_ENDS * i..][..N_ENDS].iter_mut().for_each(|open| *open &= !closed);
            }
            self.shoot_all(candidates, list.clone());
            for (i, &x) in rows.iter().enumerate() {
                for (j, &y) in columns.iter().enumerate() {
                    let lanes = &self.open[N_ENDS * i..][..N_ENDS];
                    let of_pair = lanes.iter().map(|open| (open & lanes_of(j)).count_ones());
                    let n_free = of_pair.sum::<u32>() as u8;
                    let is_visible = by_centroids[(x - first[0]) as usize] >> (y - first[1]) & 1;
                    if n_free != SEGMENTS * is_visible as u8 {
                        let [x, y] = [x, y].map(|surfel| tree.surfels[surfel as usize].node);
                        let fraction = Fraction { a: x.min(y), b: x.max(y), n_free };
                        links.push(fractions::marked(fraction));
                    }
                }
            }
        }
        candidates.truncate(start);
        (self.open, self.mixed) = (by_centroids, mixed);
    }

    /// Opens the segments of the sides whose ends face each other.
    fn faces(&mut self) {
        let [rows, columns] = &self.sides;
        rows.faces(columns, &mut self.open);
        self.is_packed = false;
        self.counts.n_segments += n_bits(&self.open);
    }

    /// Closes the open segments that are blocked, of ends that are tried, by the leaves of a list.
    fn shoot_all(&mut self, candidates: &mut Vec<Kept>, list: Range<usize>) {
        let mut rest = list;
        while self.is_open() && !rest.is_empty() {
            let piece = rest.start..rest.end.min(rest.start + PIECE);
            rest.start = piece.end;
            let start = candidates.len();
            self.refine(Depth::Leaves, candidates, piece);
            self.is_tried = true;
            for some in candidates[start..].chunks(LOADED) {
                self.try_leaves(some);
            }
            self.is_tried = false;
            candidates.truncate(start);
        }
    }

    fn is_open(&self) -> bool {
        self.open.iter().any(|&open| open != 0)
    }

    /// Loads the leaves of a block and opens the pairs that face each other.
    fn load(&mut self, a: u32, b: u32) {
        let Scene { tree, discs, profile, .. } = self.scene;
        for (side, id) in self.sides.iter_mut().zip([a, b]) {
            let node = &tree.nodes[id as usize];
            side.load(discs, node.first_surfel..node.end_surfel, profile);
        }
        self.faces();
    }

    /// Appends to a list what of a part of it may block an open segment.
    fn refine(&mut self, depth: Depth, candidates: &mut Vec<Kept>, list: Range<usize>) {
        let ends = self.ends_of(&self.open);
        let corridor = Corridor::new(&ends[0], &ends[1]);
        self.counts.n_candidates += refine(self.scene.families, &corridor, depth, candidates, list);
    }

    /// Gives the boxes of the near and the far ends of some segments, of which there are some.
    fn ends_of(&self, open: &[u64]) -> [Box3; 2] {
        let (mut rows, mut columns) = (0, 0);
        for (row, &open) in open.iter().enumerate() {
            rows |= u64::from(open != 0) << row;
            columns |= open;
        }
        [self.sides[0].box_of(rows), self.sides[1].box_of(columns)]
    }

    /// Asks the sheets of a list; closes what the surfels block that they name.
    fn try_sheets(&mut self, list: &[Kept]) {
        let Scene { discs, families, profile, sheets, .. } = self.scene;
        self.unsure.clear();
        self.unsure.resize(self.open.len(), 0);
        self.undecided.clear();
        self.sheets.clear();
        self.sheets.extend(candidates::sheets_of(families, list));
        if let Some(at) = self.sheets.iter().position(|&family| family == self.last_sheet) {
            self.sheets.swap(0, at);
        }
        let block = [&*self.sides[0], &*self.sides[1]];
        let (at_first, mut most) = (n_bits(&self.open), 0);
        let mut before = at_first;
        for &family in &self.sheets {
            let Some(sheet) = sheets.of_family(family) else { continue };
            self.counts.n_sheets += 1;
            self.screen.ask(sheet, discs, profile, block, &mut self.open);
            let left = n_bits(&self.open);
            let closed = before - left;
            self.counts.n_by_sheets += closed;
            if closed > most {
                (most, self.last_sheet) = (closed, family);
            }
            if left == 0 {
                break;
            }
            before = left;
            let mut any = 0;
            for (unsure, of_sheet) in self.unsure.iter_mut().zip(&self.screen.unsure) {
                *unsure |= of_sheet;
                any |= of_sheet;
            }
            if any != 0 {
                self.undecided.push(candidates::all_of(family));
            }
        }
        for (unsure, open) in self.unsure.iter_mut().zip(&self.open) {
            *unsure &= open;
        }
        self.is_packed &= n_bits(&self.open) == at_first;
        self.counts.n_unsure += n_bits(&self.unsure);
    }

    /// Settles what sheets left undecided by their surfels.
    fn try_undecided(&mut self, candidates: &mut Vec<Kept>) {
        if self.unsure.iter().all(|&unsure| unsure == 0) {
            return;
        }
        let start = candidates.len();
        candidates.extend_from_slice(&self.undecided);
        let ends = self.ends_of(&self.unsure);
        let corridor = Corridor::new(&ends[0], &ends[1]);
        let families = self.scene.families;
        let given = start..candidates.len();
        let from = candidates.len();
        self.counts.n_candidates += refine(families, &corridor, Depth::Leaves, candidates, given);
        let block = [&*self.sides[0], &*self.sides[1]];
        pack(block, &self.unsure, &mut self.packets);
        for (open, unsure) in self.open.iter_mut().zip(&self.unsure) {
            *open &= !unsure;
        }
        self.shoot(&candidates[from..]);
        for packet in &self.packets {
            packet.note(&mut self.open);
        }
        self.is_packed = false;
        candidates.truncate(start);
    }

    /// Settles what single leaves of a list may block.
    fn try_leaves(&mut self, list: &[Kept]) {
        let families = self.scene.families;
        let n_open = n_bits(&self.open);
        if n_open == 0 || candidates::blockers_of(families, list).next().is_none() {
            return;
        }
        self.pack(n_open);
        self.shoot(list);
        self.note();
        self.recent_pays |= (n_open - n_bits(&self.open)) * LEAST_SHARE >= n_open;
    }

    /// Closes what a remembered disc blocks.
    fn try_recent(&mut self) {
        let Scene { discs, profile, .. } = self.scene;
        let n_open = n_bits(&self.open);
        self.pack(n_open);
        let block = [&*self.sides[0], &*self.sides[1]];
        let shot = Shot { discs, profile, block, is_tried: self.is_tried };
        for packet in &mut self.packets {
            self.recent.blockers().shoot(&shot, packet, &mut self.counts);
        }
        self.note();
        let n_closed = n_open - n_bits(&self.open);
        self.counts.n_remembered += n_closed;
        self.recent_pays = n_closed * LEAST_SHARE >= n_open;
    }

    /// Packs the open segments, if they are not yet or with a quarter of the lanes idle.
    fn pack(&mut self, n_open: u64) {
        if !self.is_packed || n_open * 4 <= (self.packets.len() * WIDTH * 3) as u64 {
            pack([&self.sides[0], &self.sides[1]], &self.open, &mut self.packets);
            self.is_packed = true;
        }
    }

    /// Opens what is open in the packets, and nothing else.
    fn note(&mut self) {
        self.open.fill(0);
        for packet in &self.packets {
            packet.note(&mut self.open);
        }
    }

    /// Closes what the leaves of a list block among the segments of the packets.
    fn shoot(&mut self, list: &[Kept]) {
        let Scene { discs, families, profile, .. } = self.scene;
        self.blockers.load(discs, candidates::blockers_of(families, list));
        self.counts.n_loaded += self.blockers.len() as u64;
        let block = [&*self.sides[0], &*self.sides[1]];
        let shot = Shot { discs, profile, block, is_tried: self.is_tried };
        for packet in &mut self.packets {
            if let Some(best) = self.blockers.shoot(&shot, packet, &mut self.counts) {
                self.recent.remember(&self.blockers, best);
            }
        }
    }
}

/// Gives the lanes of the ends of leaf `j` of a side that is tried, a bit each.
fn lanes_of(j: usize) -> u64 {
    ((1 << N_ENDS) - 1) << (N_ENDS * j)
}

fn n_bits(rows: &[u64]) -> u64 {
    rows.iter().map(|row| u64::from(row.count_ones())).sum()
}

/// The decided leaf pairs of a block.
struct Block<'a> {
    tree: &'a Tree,
    /// The first surfel of the rows and of the columns.
    first: [u32; 2],
    /// The visible columns of each row, a bit each.
    open: &'a [u64],
}

impl Block<'_> {
    /// Makes statuses and links of the leaf pairs under a pair of nodes of the block.
    /// Those that are PARTIAL go to `mixed`.
    fn fold(&self, a: u32, b: u32, mixed: &mut Vec<Pair>, links: &mut Vec<Pair>) -> Status {
        let [rows, columns] = [(a, self.first[0]), (b, self.first[1])].map(|(id, first)| {
            let node = &self.tree.nodes[id as usize];
            (node.first_surfel - first) as usize..(node.end_surfel - first) as usize
        });
        let mask = (u64::MAX >> (u64::BITS as usize - columns.len())) << columns.start;
        let rows = &self.open[rows];
        if rows.iter().all(|open| open & mask == 0) {
            return Status::Invisible;
        }
        if rows.iter().all(|open| open & mask == mask) {
            return Status::Visible;
        }
        mixed.push((a, b));
        for x in self.tree.kids(a) {
            for y in self.tree.kids(b) {
                if self.fold(x, y, mixed, links) == Status::Visible {
                    links.push((x.min(y), x.max(y)));
                }
            }
        }
        Status::Partial
    }
}
