//! `--segment`: pairs asked by the segment between the places themselves.

use std::io::Write;

use pvmap::query::{Located, PairAnswer, Place, SegmentAnswer, SettledBy, Spot};
use pvmap::rows::{Row, RowBlock};
use serde_json::{Value, json};

use super::batch::{Batch, RowError};
use super::pair;
use super::pairs::{Ask, Pairs};

/// Gives the word of a key for what settled a pair.
fn word(settled_by: SettledBy) -> &'static str {
    match settled_by {
        SettledBy::Leaf => "leaf",
        SettledBy::Facing => "facing",
        SettledBy::Link => "link",
        SettledBy::Blocker(_) => "blocker",
        SettledBy::NoBlocker => "no blocker",
    }
}

/// Says what settled a pair.
pub(super) fn words(settled_by: SettledBy) -> String {
    match settled_by {
        SettledBy::Leaf => "not asked: both lie on one surfel".to_owned(),
        SettledBy::Facing => "one of the places looks away from the other".to_owned(),
        SettledBy::Link => "not asked: the link settles it".to_owned(),
        SettledBy::Blocker(surfel) => format!("surfel {surfel} blocks it"),
        SettledBy::NoBlocker => "no surfel blocks it".to_owned(),
    }
}

fn blocker_of(answer: &SegmentAnswer) -> Option<u32> {
    match answer.settled_by {
        SettledBy::Blocker(surfel) => Some(surfel),
        _ => None,
    }
}

/// Adds the answer to that of the leaves.
pub(super) fn add_to(object: &mut Value, answer: &SegmentAnswer) {
    object["leaves"] = object["visible"].clone();
    object["visible"] = json!(answer.visible);
    object["segment"] = json!({
        "settled_by": word(answer.settled_by),
        "blocker": blocker_of(answer),
    });
}

/// Pairs that are asked by their segments.
pub(super) struct SegmentPairs<'q, 'm, 'a>(pub(super) Pairs<'q, 'm, 'a>);

impl Batch for SegmentPairs<'_, '_, '_> {
    type Answer = ((Spot, Spot), SegmentAnswer);

    const HEADER: &'static str = "visible,surfel1,surfel2,distance1,distance2,leaves,blocker,error";

    fn answers(&self, rows: &RowBlock) -> Vec<Result<Self::Answer, RowError>> {
        let map = self.0.asked.map;
        let find = |row: Row<'_>| -> Result<(Spot, Spot), RowError> {
            let spot =
                |(place, located): (Place, Located)| self.0.asked.of_row(map.spot(&place, located));
            let [a, b] = self.0.locate(row)?;
            Ok((spot(a)?, spot(b)?))
        };
        self.0.ask(
            rows,
            &Ask {
                find: &find,
                keep: &|memory_bytes| map.keep_discs(memory_bytes),
                one: &|(a, b)| map.pair_by_segment(a, b),
                many: &|questions| map.pairs_by_segment(questions),
            },
        )
    }

    fn write(&self, ((a, b), answer): &Self::Answer, out: &mut Vec<u8>) -> std::io::Result<()> {
        let by_leaves = answer.by_leaves;
        let said = PairAnswer { visible: answer.visible, ..by_leaves };
        self.0.write(&((*a.located(), *b.located()), said), out)?;
        write!(out, "{},", u8::from(by_leaves.visible))?;
        match blocker_of(answer) {
            Some(surfel) => write!(out, "{surfel},"),
            None => write!(out, ","),
        }
    }

    fn object(&self, ((a, b), answer): &Self::Answer) -> Value {
        let mut object = pair::as_json(a.located(), b.located(), &answer.by_leaves);
        add_to(&mut object, answer);
        object
    }
}
