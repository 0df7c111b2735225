//! Shafts between boxes.
