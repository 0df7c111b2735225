//! Light: radiosity on the surfels of a map.
//!
//! Light that every [`Element`] emits (E) and reflects (albedo ρ) reaches those that see it:
//! B_i = E_i + ρ_i H_i, H_i = (1/A_i) Σ_j G_ij B_j. What sees what say the links of the map.
//! [`Kernel`] is the exchange G of two elements, bounded and the same from either end;
//! [`Exchange`] applies G as a whole, pair by pair (the oracle) or by the fast multipole method
//! (`fmm`), for which links are just right: under a link the exchange is smooth.
//! [`Balanced`] scales G so that no element gets more light than there is, [`solve`] finds B;
//! [`Irradiance`] gives places between elements theirs. What mirrors or lets light through throws
//! it by photons, and [`Glimpses`] follows rays of an eye through it.
//!
//! The room prints nothing, opens no file but nameless ones for lists that do not fit the memory,
//! and never asks whether two elements see each other: a pair without a link exchanges nothing.
//! Results have the same bits for any number of threads.
//!
//! Start reading at [`Elements::of_map`], then [`Exchange`] and [`solve`].

mod area;
mod balance;
mod element;
mod error;
mod exchange;
mod fmm;
mod glimpse;
mod hierarchy;
mod incident;
mod interpolate;
mod kernel;
mod lamp;
mod lighting;
mod lists;
mod material;
mod near_field;
mod number;
mod optics;
mod passes;
mod plan;
mod planner;
mod polygon;
mod precision;
mod refine;
mod section;
mod solve;
mod specular;
mod sum;
mod surroundings;
mod throw;
mod vector;

pub use area::areas_grid2;
pub use balance::{Balanced, Scaling, Scene};
pub use element::{Element, Elements};
pub use error::LightError;
pub use exchange::{Exchange, ExchangeStats, Interaction};
pub use glimpse::{Glimpse, Glimpses, SeenAt};
pub use hierarchy::{Hierarchy, Links, Span, Subtree};
pub use interpolate::Irradiance;
pub use kernel::Kernel;
pub use lamp::{Lamp, Sky, solid_angle_of_cone};
pub use lighting::{LightOptions, Lighting, Lit, LitChannel, Planned, Work};
pub use material::{Channel, Materials};
pub use plan::{Decision, Effect, Outlook, Plan, Wishes};
pub use pvmap_vmap::light::Gloss;
pub use solve::{FluxBalance, Method, Operator, Solution, SolveOptions, solve};
pub use specular::ThrownFlux;
pub use throw::MAX_ROUNDS;
