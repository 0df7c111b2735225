//! What `lights.toml` says once it is checked, and its canonical text.

use std::f64::consts::PI;
use std::fmt::Write as _;

use pvmap_light::{Lamp, Sky, solid_angle_of_cone};

/// Red, green and blue in linear light.
pub(super) type Rgb = [f64; 3];
/// World units along x, y, z, or a direction.
pub(super) type Vector = [f64; 3];

/// All rules. Equal rules have equal texts.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Rules {
    pub(super) albedo: Albedo,
    pub(super) glows: Vec<Glow>,
    pub(super) materials: Vec<Material>,
    /// Points, then spots, then areas.
    pub(super) lamps: Vec<LampRule>,
    pub(super) sun: Option<Sun>,
    /// Radiance, and up as it is said.
    pub(super) sky: Option<Sky>,
}

/// Where albedo comes from.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Albedo {
    /// The scan's colours times `exposure`, at most `max`.
    Scan { exposure: f64, max: f64, missing: Rgb },
    /// The same everywhere.
    Constant(Rgb),
}

/// Which surfels a rule is about.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Selection {
    All,
    /// Lowest and highest corner.
    Box(Vector, Vector),
    /// Middle and radius.
    Sphere(Vector, f64),
    /// An ASPRS class.
    Class(u8),
    /// A mean colour, and how far from it one may be.
    Color(Rgb, f64),
    /// The one nearest to a place.
    Near(Vector),
}

/// How much light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Power {
    /// Flux an area, or a solid angle.
    Density(Rgb),
    /// In all.
    Flux(Rgb),
}

/// Surfels that shine.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Glow {
    pub(super) on: Selection,
    pub(super) power: Power,
}

/// What surfels are made of; what is not said stays as it was.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Material {
    pub(super) on: Selection,
    pub(super) albedo: Option<Rgb>,
    pub(super) specular: Option<f64>,
    pub(super) transmissive: Option<f64>,
    pub(super) refraction: Option<f64>,
}

/// An added light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum LampRule {
    Point { position: Vector, power: Power },
    Spot { position: Vector, aim: Aim, angle: f64, power: Power },
    Area { corner: Vector, sides: [Vector; 2], power: Power },
}

/// Where a spot shines to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Aim {
    Direction(Vector),
    Target(Vector),
}

/// The sun.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sun {
    pub(super) to: ToSun,
    pub(super) irradiance: Rgb,
}

/// Where the sun is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum ToSun {
    Direction(Vector),
    /// Degrees, clockwise from +y and above the level.
    Angles {
        azimuth: f64,
        elevation: f64,
    },
}

impl Power {
    /// Gives the flux a unit of what `whole` is the amount of.
    pub(super) fn over(self, whole: f64) -> Rgb {
        match self {
            Power::Density(density) => density,
            Power::Flux(flux) => flux.map(|v| v / whole),
        }
    }
}

impl LampRule {
    /// Makes the lamp.
    pub(super) fn lamp(&self) -> Lamp {
        match *self {
            LampRule::Point { position, power } => {
                Lamp::Point { position, intensity: power.over(4.0 * PI) }
            }
            LampRule::Spot { position, aim, angle, power } => {
                let along = match aim {
                    Aim::Direction(along) => along,
                    Aim::Target(target) => [0, 1, 2].map(|i| target[i] - position[i]),
                };
                let angle = angle.to_radians();
                let intensity = power.over(solid_angle_of_cone(angle));
                Lamp::Spot { position, direction: unit(along), angle, intensity }
            }
            LampRule::Area { corner, sides, power } => {
                let exitance = power.over(length(cross(sides[0], sides[1])));
                Lamp::Area { corner, sides, exitance }
            }
        }
    }
}

impl Sun {
    /// Makes the lamp.
    pub(super) fn lamp(&self) -> Lamp {
        let direction = match self.to {
            ToSun::Direction(to) => unit(to),
            ToSun::Angles { azimuth, elevation } => {
                let level = cos_degrees(elevation);
                let (east, north) = (cos_degrees(azimuth - 90.0), cos_degrees(azimuth));
                [level * east, level * north, cos_degrees(elevation - 90.0)]
            }
        };
        Lamp::Sun { direction, irradiance: self.irradiance }
    }
}

/// Gives a cosine; exact at right angles.
fn cos_degrees(angle: f64) -> f64 {
    match angle.abs() % 360.0 {
        90.0 | 270.0 => 0.0,
        180.0 => -1.0,
        other => other.to_radians().cos(),
    }
}

/// Gives a direction of length 1; whatever its length was, neither 0 nor infinite.
pub(super) fn unit(v: Vector) -> Vector {
    let most = v.iter().fold(0.0, |most: f64, c| most.max(c.abs()));
    let v = v.map(|c| c / most);
    let length = length(v);
    v.map(|c| c / length)
}

pub(super) fn cross(u: Vector, v: Vector) -> Vector {
    [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
}

pub(super) fn length(v: Vector) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

/// A text that grows by tables and keys.
#[derive(Debug, Default)]
struct Text(String);

impl Text {
    fn table(&mut self, header: &str) {
        let gap = if self.0.is_empty() { "" } else { "\n" };
        self.0.push_str(&format!("{gap}{header}\n"));
    }

    fn value(&mut self, key: &str, value: impl std::fmt::Debug) {
        // A String takes all that is written.
        let _ = writeln!(self.0, "{key} = {value:?}");
    }

    fn color(&mut self, key: &str, color: Rgb) {
        match color {
            [r, g, b] if r == g && g == b => self.value(key, r),
            _ => self.value(key, color),
        }
    }

    fn selection(&mut self, on: &Selection) {
        match *on {
            Selection::All => self.value("all", true),
            Selection::Box([a, b, c], [d, e, f]) => self.value("box", [a, b, c, d, e, f]),
            Selection::Sphere([x, y, z], r) => self.value("sphere", [x, y, z, r]),
            Selection::Class(class) => self.value("class", class),
            Selection::Color(color, within) => {
                self.color("color", color);
                self.value("within", within);
            }
            Selection::Near(place) => self.value("near", place),
        }
    }

    fn power(&mut self, density: &str, power: Power) {
        match power {
            Power::Density(color) => self.color(density, color),
            Power::Flux(color) => self.color("flux", color),
        }
    }

    fn lamp(&mut self, lamp: &LampRule) {
        match *lamp {
            LampRule::Point { position, power } => {
                self.table("[[point]]");
                self.value("position", position);
                self.power("intensity", power);
            }
            LampRule::Spot { position, aim, angle, power } => {
                self.table("[[spot]]");
                self.value("position", position);
                match aim {
                    Aim::Direction(along) => self.value("direction", along),
                    Aim::Target(target) => self.value("target", target),
                }
                self.value("angle", angle);
                self.power("intensity", power);
            }
            LampRule::Area { corner, sides, power } => {
                self.table("[[area]]");
                self.value("corner", corner);
                self.value("sides", sides);
                self.power("exitance", power);
            }
        }
    }
}

impl Rules {
    /// Writes them as the canonical text, in which nothing is left to a default.
    pub(super) fn to_text(&self) -> String {
        let mut text = Text::default();
        text.table("[albedo]");
        match self.albedo {
            Albedo::Scan { exposure, max, missing } => {
                text.value("from", "scan");
                text.value("exposure", exposure);
                text.value("max", max);
                text.color("missing", missing);
            }
            Albedo::Constant(color) => text.color("from", color),
        }
        for glow in &self.glows {
            text.table("[[glow]]");
            text.selection(&glow.on);
            text.power("exitance", glow.power);
        }
        for material in &self.materials {
            text.table("[[material]]");
            text.selection(&material.on);
            material.albedo.inspect(|&color| text.color("albedo", color));
            material.specular.inspect(|v| text.value("specular", v));
            material.transmissive.inspect(|v| text.value("transmissive", v));
            material.refraction.inspect(|v| text.value("refraction", v));
        }
        self.lamps.iter().for_each(|lamp| text.lamp(lamp));
        if let Some(Sun { to, irradiance }) = self.sun {
            text.table("[sun]");
            match to {
                ToSun::Direction(to) => text.value("direction", to),
                ToSun::Angles { azimuth, elevation } => {
                    text.value("azimuth", azimuth);
                    text.value("elevation", elevation);
                }
            }
            text.color("irradiance", irradiance);
        }
        if let Some(Sky { radiance, up }) = self.sky {
            text.table("[sky]");
            text.color("radiance", radiance);
            text.value("up", up);
        }
        text.0
    }
}
