//! Generated scenes from a seed, with exact truth: do these two points see each other?
//!
//! A scene is a list of surfaces (`shape`) in a tree of boxes (`bvh`): quads, triangles and
//! spheres, each with a paint. The rooms are made of a few (`rooms`), the cave of some hundred
//! thousand triangles around the void of an implicit field (`cave`, `noise`, `polygonise`); models
//! that others have read from files stand in a room as statues (`mesh`).
//! Points are sampled from the surfaces in the order of a scanner or shuffled (`points`), and may
//! be recorded with noise, holes and wrong normals (`defects`, `holes`, `kept`); the truth is asked
//! of the surfaces themselves (`truth`), never of the points.
//!
//! The room opens no file, prints nothing and knows nothing of grids, trees or maps. Points are
//! the same bits on every host: they come from integer hashes, from + - × ÷ √ alone, and from no
//! state that threads share.
//!
//! Start reading at [`Scene`].

mod bvh;
mod cave;
mod defects;
mod holes;
mod kept;
mod kind;
mod mesh;
mod noise;
mod paint;
mod points;
mod polygonise;
mod random;
mod rooms;
mod scene;
mod shape;
mod truth;
mod vector;

pub use defects::{Defects, HOLE_RADIUS, Scan};
pub use kind::{SceneError, SceneKind};
pub use mesh::{Mesh, Up};
pub use points::{MOST_POINTS, Points, Sample};
pub use scene::Scene;
