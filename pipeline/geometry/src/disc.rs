//! The exact leaf-pair test.
