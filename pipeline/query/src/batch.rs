//! Many pairs at once: the answers of [`Map::pair`], with each link frame decoded once.
//!
//! A question looks for a handful of links, each in a frame of its own, and in a large map the next
//! question needs others. So the links that many questions look for are sorted first: those of a
//! frame then stand side by side.

use pvmap_vmap::FormatError;
use rayon::prelude::*;

use crate::error::QueryError;
use crate::frames::Lookup;
use crate::locate::Located;
use crate::map::{MAX_PATH, Map};
use crate::pair::PairAnswer;

/// Links looked for at once: 64 MiB of them at the most, 7 MiB for 64 Ki usual questions.
const BLOCK_LINKS: usize = 1 << 22;
/// Questions, or links, that a thread takes at a time.
const PIECE: usize = 1 << 12;

/// A link that a question looks for.
#[derive(Debug, Clone, Copy)]
struct Wanted {
    link: (u32, u32),
    /// The question's place in its block.
    question: u32,
    /// The link's place among those of the question, the highest first.
    rank: u16,
}

/// A link that is there, or cannot be read.
type Hit = (Wanted, Result<(), FormatError>);

impl Map<'_> {
    /// Decides many pairs of located places; the answers are those of [`Map::pair`], in order.
    /// Threads are those of the current rayon pool.
    pub fn pairs(&self, questions: &[(Located, Located)]) -> Vec<Result<PairAnswer, QueryError>> {
        // From given pairs any node over the one leaf may be linked to any over the other.
        let most = if self.from_given_pairs() { MAX_PATH * MAX_PATH } else { MAX_PATH };
        let blocks = questions.chunks(BLOCK_LINKS / most);
        blocks.flat_map(|block| self.pairs_of_block(block)).collect()
    }

    fn pairs_of_block(
        &self,
        questions: &[(Located, Located)],
    ) -> Vec<Result<PairAnswer, QueryError>> {
        let (mut wanted, mut hits) = self.wanted(questions);
        wanted.par_sort_unstable_by_key(|w| w.link);
        hits.par_extend(wanted.par_chunks(PIECE).flat_map_iter(|piece| {
            let mut lookup = Lookup::new(self.view(), &self.frames);
            piece.iter().filter_map(move |&w| match lookup.contains(w.link) {
                Ok(false) => None,
                Ok(true) => Some((w, Ok(()))),
                Err(e) => Some((w, Err(e))),
            })
        }));
        // Of a question's hits the first counts, as if the links had been tried in turn.
        let mut first: Vec<Option<&Hit>> = vec![None; questions.len()];
        for hit in &hits {
            let found = &mut first[hit.0.question as usize];
            if found.is_none_or(|other| hit.0.rank < other.0.rank) {
                *found = Some(hit);
            }
        }
        let answer = |(&(a, b), found): (&(Located, Located), &Option<&Hit>)| match found {
            None => Ok(PairAnswer { visible: a.node == b.node, link: None }),
            Some((wanted, Ok(()))) => self.seen_by(&a, &b, wanted.link),
            Some((_, Err(e))) => Err(e.clone().into()),
        };
        questions.par_iter().zip(&first).map(answer).collect()
    }

    /// Lists what questions look for. A question whose nodes cannot be read is a hit already.
    fn wanted(&self, questions: &[(Located, Located)]) -> (Vec<Wanted>, Vec<Hit>) {
        let of_piece = |(piece, first): (&[(Located, Located)], usize)| {
            let (mut wanted, mut broken) = (Vec::new(), Vec::new());
            for ((a, b), question) in piece.iter().zip(first as u32..) {
                if a.node == b.node {
                    continue;
                }
                match self.links_over(a, b) {
                    Ok(over) => wanted.extend((0..over.len()).map(|rank| {
                        let link = over.nth(rank);
                        Wanted { link, question, rank: rank as u16 }
                    })),
                    Err(e) => broken.push((Wanted { link: (0, 0), question, rank: 0 }, Err(e))),
                }
            }
            (wanted, broken)
        };
        let pieces = questions.par_chunks(PIECE).enumerate();
        let lists: Vec<(Vec<Wanted>, Vec<Hit>)> =
            pieces.map(|(i, piece)| of_piece((piece, i * PIECE))).collect();
        let (wanted, broken): (Vec<_>, Vec<_>) = lists.into_iter().unzip();
        (wanted.concat(), broken.concat())
    }
}
