//! The room's answers against slow obvious ones, on maps made in memory.

#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;
mod exact;
mod hostile;
mod locate;
mod octree;
mod pair;
mod quality;
mod rays;
mod regions;
mod sound;
mod visible;
mod wide;
