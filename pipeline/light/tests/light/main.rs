//! Light on generated surfaces, against closed forms and slow obvious sums.

#![allow(clippy::unwrap_used, reason = "a test fails where it unwraps nothing")]

mod common;
mod exact_answers;
mod exchange;
mod hard_cases;
mod multipole;
mod solver;
