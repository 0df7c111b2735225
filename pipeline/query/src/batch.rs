//! Many pairs at once: the answers of [`Map::pair`], with each link frame decoded about once.
//!
//! The links that can settle a question stand in the lists of the nodes over its earlier leaf, a
//! handful of frames. So questions are taken in the order of that leaf: the next needs mostly the
//! frames of the one before.

use rayon::prelude::*;

use crate::error::QueryError;
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
        let mut order: Vec<usize> = (0..questions.len()).collect();
        order.par_sort_unstable_by_key(|&i| {
            let (a, b) = &questions[i];
            (a.node.min(b.node), a.node.max(b.node))
        });
        let answered: Vec<_> = order
            .par_chunks(PIECE)
            .flat_map_iter(|piece| {
                let mut lookup = Lookup::new(self);
                piece.iter().map(move |&i| {
                    let (a, b) = &questions[i];
                    (i, self.pair_with(&mut lookup, a, b))
                })
            })
            .collect();
        let nothing = PairAnswer { visible: false, link: None };
        let mut answers = vec![Ok(nothing); questions.len()];
        for (i, answer) in answered {
            answers[i] = answer;
        }
        answers
    }
}
