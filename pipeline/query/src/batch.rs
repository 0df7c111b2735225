//! Many pairs at once: the answers of [`Map::pair`], [`Map::pair_by_segment`] or
//! [`Map::pair_fraction`], with each frame decoded about once.
//!
//! The links that can settle a question stand in the lists of the nodes over its earlier leaf, a
//! handful of frames. So questions are taken in the order of that leaf: the next needs mostly the
//! frames of the one before.

use rayon::prelude::*;

use crate::by_segment::{SegmentAnswer, Spot};
use crate::error::QueryError;
use crate::fraction::FractionAnswer;
use crate::frames::Lookup;
use crate::locate::Located;
use crate::map::Map;
use crate::pair::PairAnswer;

/// Questions that a thread takes at a time.
const PIECE: usize = 1 << 11;

impl Map<'_> {
    /// Decides many pairs of located places; the answers are those of [`Map::pair`], in order.
    /// Threads are those of the current rayon pool; they hold some 100 bytes a question besides
    /// the answers.
    pub fn pairs(&self, questions: &[(Located, Located)]) -> Vec<Result<PairAnswer, QueryError>> {
        let nodes = |(a, b): &(Located, Located)| [a.node, b.node];
        self.by_leaves(questions, nodes, |lookup, (a, b)| self.pair_with(lookup, a, b))
    }

    /// Decides many pairs of places by their segments; the answers are those of
    /// [`Map::pair_by_segment`], in order, and threads those of the current rayon pool.
    pub fn pairs_by_segment(
        &self,
        questions: &[(Spot, Spot)],
    ) -> Vec<Result<SegmentAnswer, QueryError>> {
        let nodes = |(a, b): &(Spot, Spot)| [a.located().node, b.located().node];
        self.by_leaves(questions, nodes, |lookup, (a, b)| self.segment_with(lookup, a, b))
    }

    /// Gives how much the leaves of many pairs of places see of each other; the answers are those
    /// of [`Map::pair_fraction`], in order, and threads those of the current rayon pool.
    pub fn pairs_fractions(
        &self,
        questions: &[(Located, Located)],
    ) -> Vec<Result<FractionAnswer, QueryError>> {
        let nodes = |(a, b): &(Located, Located)| [a.node, b.node];
        self.by_leaves(questions, nodes, |lookup, (a, b)| self.fraction_with(lookup, a, b))
    }

    /// Answers questions in the order of their leaves; gives the answers in that of the questions.
    fn by_leaves<Q: Sync, A: Send>(
        &self,
        questions: &[Q],
        nodes: impl Fn(&Q) -> [u32; 2] + Sync,
        answer: impl Fn(&mut Lookup<'_, '_>, &Q) -> A + Sync,
    ) -> Vec<A> {
        let mut order: Vec<usize> = (0..questions.len()).collect();
        order.par_sort_unstable_by_key(|&i| {
            let [a, b] = nodes(&questions[i]);
            (a.min(b), a.max(b))
        });
        let answer = &answer;
        let answered: Vec<(usize, A)> = order
            .par_chunks(PIECE)
            .flat_map_iter(|piece| {
                let mut lookup = Lookup::new(self);
                piece.iter().map(move |&i| (i, answer(&mut lookup, &questions[i])))
            })
            .collect();
        let mut answers: Vec<Option<A>> = questions.iter().map(|_| None).collect();
        for (i, answer) in answered {
            answers[i] = Some(answer);
        }
        // Every place of the order is one question's.
        answers.into_iter().flatten().collect()
    }
}
