//! `--fraction`: how much of each other the leaves of pairs see.

use std::io::{self, Write};

use pvmap::Error;
use pvmap::query::{FractionAnswer, Located};
use pvmap::rows::{Row, RowBlock};
use pvmap::vmap::fraction::SEGMENTS;
use serde_json::{Value, json};

use super::batch::{Batch, RowError};
use super::pairs::{Ask, Pairs};
use super::{Asked, pair};

/// Makes sure that a map has visible fractions.
pub(super) fn require(asked: &Asked<'_, '_>) -> Result<(), Error> {
    if asked.map.has_fractions() {
        return Ok(());
    }
    let path = asked.path.display();
    Err(Error::Usage(format!(
        "{path}: this map has no visible fractions; make one with pvmap build --fractions"
    )))
}

/// Adds the fraction to the answer of the leaves.
pub(super) fn add_to(object: &mut Value, answer: &FractionAnswer) {
    object["fraction"] = json!(answer.fraction());
    object["tried"] = json!(answer.tried.map(|(a, b)| [a, b]));
}

/// Writes the fraction for people.
pub(super) fn write(out: &mut impl Write, answer: &FractionAnswer) -> io::Result<()> {
    let (fraction, n_free) = (answer.fraction(), answer.n_free);
    match answer.tried {
        Some((a, b)) => writeln!(
            out,
            "  fraction  {fraction}: {n_free} of {SEGMENTS} segments between nodes {a} and {b}"
        ),
        None => writeln!(out, "  fraction  {fraction}: by the links"),
    }
}

/// Pairs whose visible fractions are asked for.
pub(super) struct FractionPairs<'q, 'm, 'a>(pub(super) Pairs<'q, 'm, 'a>);

impl Batch for FractionPairs<'_, '_, '_> {
    type Answer = ((Located, Located), FractionAnswer);

    const HEADER: &'static str = "visible,surfel1,surfel2,distance1,distance2,fraction,error";

    fn answers(&self, rows: &RowBlock) -> Vec<Result<Self::Answer, RowError>> {
        let map = self.0.asked.map;
        let find = |row: Row<'_>| -> Result<(Located, Located), RowError> {
            self.0.locate(row).map(|[(_, a), (_, b)]| (a, b))
        };
        self.0.ask(
            rows,
            &Ask {
                find: &find,
                // Fractions are not kept: frames are decoded in the order of the leaves.
                keep: &|_| Ok(false),
                one: &|(a, b)| map.pair_fraction(a, b),
                many: &|questions| map.pairs_fractions(questions),
            },
        )
    }

    fn write(&self, ((a, b), answer): &Self::Answer, out: &mut Vec<u8>) -> io::Result<()> {
        self.0.write(&((*a, *b), answer.by_leaves), out)?;
        write!(out, "{},", answer.fraction())
    }

    fn object(&self, ((a, b), answer): &Self::Answer) -> Value {
        let mut object = pair::as_json(a, b, &answer.by_leaves);
        add_to(&mut object, answer);
        object
    }
}
