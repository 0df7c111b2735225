//! The room's answers against slow obvious ones, on maps made in memory.

mod common;
mod hostile;
mod locate;
mod pair;
mod speed;
