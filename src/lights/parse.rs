//! From the text of `lights.toml` to checked rules.

use std::ops::RangeInclusive;

use pvmap_light::{Lamp, Sky};
use toml::de::DeTable;

use super::rules::{
    Aim, Albedo, Glow, LampRule, Material, Power, Rules, Selection, Sun, ToSun, cross, length, unit,
};
use super::table::{Fault, Table, Value, fault};

/// What a share may be.
const SHARE: &str = "0 to 1";
/// What an amount of light may be.
const AMOUNT: &str = "0 or more, at most 1e30";
/// The most light that is computed with: light files hold numbers of 32 bits, to 3e38, and light
/// adds up.
pub(super) const MAX_LIGHT: f64 = 1e30;
/// Indices of refraction: nothing that light goes through is denser.
const REFRACTION: RangeInclusive<f64> = 1.0..=10.0;
/// How far the parts of a material may be above 1 in all: thirds are rounded.
pub(super) const SHARE_TOLERANCE: f64 = 1e-9;
/// Sine of the least angle between the sides of a parallelogram.
const LEAST_SINE: f64 = 1e-12;

/// The rules of a text, with the bytes that glows and materials begin at.
pub(super) struct Parsed {
    pub(super) rules: Rules,
    pub(super) glows_at: Vec<usize>,
    pub(super) materials_at: Vec<usize>,
}

/// Reads the table of a lamp.
type ReadLamp = fn(&Table<'_>) -> Result<LampRule, Fault>;

/// Reads and checks a text.
pub(super) fn parse(text: &str) -> Result<Parsed, Fault> {
    let document = DeTable::parse(text).map_err(|e| Fault {
        at: e.span().map_or(0, |span| span.start.min(text.len())),
        what: e.message().trim_end().replace('\n', "; "),
    })?;
    let known = ["albedo", "glow", "material", "point", "spot", "area", "sun", "sky"];
    let all = Table::whole(text, document.get_ref(), &known)?;
    let glows = tables(&all, "glow", &with_selection(&["exitance", "flux"]))?;
    let shares = ["albedo", "specular", "transmissive", "refraction"];
    let materials = tables(&all, "material", &with_selection(&shares))?;
    let mut lamps = Vec::new();
    let kinds: [(&str, &[&str], ReadLamp); 3] = [
        ("point", &["position", "flux", "intensity"], point),
        ("spot", &["position", "direction", "target", "angle", "flux", "intensity"], spot),
        ("area", &["corner", "sides", "flux", "exitance"], area),
    ];
    for (kind, known, read) in kinds {
        for table in tables(&all, kind, known)? {
            lamps.push(checked(&table, read(&table)?)?);
        }
    }
    let sun = ["direction", "azimuth", "elevation", "irradiance"];
    let rules = Rules {
        albedo: albedo(all.get("albedo"))?,
        glows: glows.iter().map(glow).collect::<Result<_, _>>()?,
        materials: materials.iter().map(material).collect::<Result<_, _>>()?,
        lamps,
        sun: all.get("sun").map(|v| v.table(&sun).and_then(|t| self::sun(&t))).transpose()?,
        sky: all.get("sky").map(|v| v.table(&["radiance", "up"]).and_then(sky)).transpose()?,
    };
    let at = |tables: &[Table<'_>]| tables.iter().map(|table| table.at).collect();
    Ok(Parsed { rules, glows_at: at(&glows), materials_at: at(&materials) })
}

/// Reads the tables of a kind, none where there is none.
fn tables<'a>(all: &Table<'a>, kind: &'a str, known: &[&str]) -> Result<Vec<Table<'a>>, Fault> {
    all.get(kind).map_or(Ok(Vec::new()), |value| value.tables(known))
}

/// The keys that select surfels.
const SELECTIONS: [&str; 6] = ["box", "sphere", "class", "color", "near", "all"];

fn with_selection(keys: &[&'static str]) -> Vec<&'static str> {
    keys.iter().copied().chain(SELECTIONS).chain(["within"]).collect()
}

fn is_share(v: f64) -> bool {
    (0.0..=1.0).contains(&v)
}

fn is_amount(v: f64) -> bool {
    (0.0..=MAX_LIGHT).contains(&v)
}

fn albedo(value: Option<Value<'_>>) -> Result<Albedo, Fault> {
    let of_scan = Albedo::Scan { exposure: 1.0, max: 0.95, missing: [0.5; 3] };
    let Some(value) = value else { return Ok(of_scan) };
    let table = value.table(&["from", "exposure", "max", "missing"])?;
    if let Some(from) = table.get("from").filter(|from| from.text() != Some("scan")) {
        if from.text().is_some_and(|text| !text.starts_with('#')) {
            return from.refuse("\"scan\" or a colour");
        }
        let color = from.color(SHARE, is_share)?;
        let unused = ["exposure", "max", "missing"].iter().find_map(|key| table.get(key));
        return match unused {
            None => Ok(Albedo::Constant(color)),
            Some(v) => {
                let what = format!("`{}` is for from = \"scan\"; leave it out", v.key());
                fault(v.at(), what)
            }
        };
    }
    let Albedo::Scan { mut exposure, mut max, mut missing } = of_scan else { return Ok(of_scan) };
    if let Some(v) = table.get("exposure") {
        exposure = v.number_in("above 0", |v| v > 0.0)?;
    }
    if let Some(v) = table.get("max") {
        max = v.number_in("0 or more and below 1", |v| (0.0..1.0).contains(&v))?;
    }
    if let Some(v) = table.get("missing") {
        missing = v.color(SHARE, is_share)?;
    }
    Ok(Albedo::Scan { exposure, max, missing })
}

fn selection(table: &Table<'_>) -> Result<Selection, Fault> {
    let value = table.one_of(&SELECTIONS)?;
    let within = table.get("within");
    if let Some(within) = within.as_ref().filter(|_| value.key() != "color") {
        return fault(within.at(), "`within` says how far from a `color`; leave it out");
    }
    match value.key() {
        "all" => value.is_true().map(|()| Selection::All),
        "box" => {
            let form = "[x0, y0, z0, x1, y1, z1]";
            let [a, b, c, d, e, f] = value.numbers(form)?;
            if a > d || b > e || c > f {
                return value.refuse(&format!("{form}, the lowest corner first"));
            }
            Ok(Selection::Box([a, b, c], [d, e, f]))
        }
        "sphere" => {
            let [x, y, z, radius] = value.numbers("[x, y, z, radius]")?;
            if radius <= 0.0 {
                return value.refuse("[x, y, z, radius], the radius above 0");
            }
            Ok(Selection::Sphere([x, y, z], radius))
        }
        "class" => value.byte().map(Selection::Class),
        "near" => value.vector().map(Selection::Near),
        _ => {
            let color = value.color(SHARE, is_share)?;
            let Some(within) = within else {
                return fault(value.at(), "`within` is missing: how far a surfel's colour may be");
            };
            Ok(Selection::Color(color, within.number_in("0 or more", |v| v >= 0.0)?))
        }
    }
}

fn power<'a>(table: &Table<'a>, density: &'a str) -> Result<Power, Fault> {
    let value = table.one_of(&[density, "flux"])?;
    let color = value.color(AMOUNT, is_amount)?;
    Ok(if value.key() == "flux" { Power::Flux(color) } else { Power::Density(color) })
}

fn glow(table: &Table<'_>) -> Result<Glow, Fault> {
    Ok(Glow { on: selection(table)?, power: power(table, "exitance")? })
}

fn material(table: &Table<'_>) -> Result<Material, Fault> {
    let share = |key| match table.get(key) {
        None => Ok(None),
        Some(v) => v.number_in(SHARE, is_share).map(Some),
    };
    let on = selection(table)?;
    let albedo = table.get("albedo").map(|v| v.color(SHARE, is_share)).transpose()?;
    let (specular, transmissive) = (share("specular")?, share("transmissive")?);
    let refraction = match table.get("refraction") {
        None => None,
        Some(v) => Some(v.number_in("1 to 10", |v| REFRACTION.contains(&v))?),
    };
    if albedo.is_none() && specular.or(transmissive).or(refraction).is_none() {
        let what = "nothing is said of the material; give albedo, specular, transmissive or \
                    refraction";
        return fault(table.at, what);
    }
    let diffuse = albedo.map_or(0.0, |color| color.into_iter().fold(0.0, f64::max));
    let sum = diffuse + specular.unwrap_or(0.0) + transmissive.unwrap_or(0.0);
    if sum > 1.0 + SHARE_TOLERANCE {
        let parts = ["albedo", "specular", "transmissive"].iter().filter_map(|key| table.get(key));
        let at = parts.map(|v| v.at()).max().unwrap_or(table.at);
        let what = format!("albedo + specular + transmissive is {sum}: it must be at most 1");
        return fault(at, what);
    }
    Ok(Material { on, albedo, specular, transmissive, refraction })
}

fn point(table: &Table<'_>) -> Result<LampRule, Fault> {
    let position = table.need("position")?.vector()?;
    Ok(LampRule::Point { position, power: power(table, "intensity")? })
}

fn spot(table: &Table<'_>) -> Result<LampRule, Fault> {
    let position = table.need("position")?.vector()?;
    let to = table.one_of(&["direction", "target"])?;
    let aim = match to.key() {
        "direction" => Aim::Direction(to.direction()?),
        _ => match to.vector()? {
            target if target == position => return to.refuse("elsewhere than `position`"),
            target => Aim::Target(target),
        },
    };
    let angle = table.need("angle")?;
    let angle = angle.number_in("above 0 and at most 180", |v| v > 0.0 && v <= 180.0)?;
    Ok(LampRule::Spot { position, aim, angle, power: power(table, "intensity")? })
}

fn area(table: &Table<'_>) -> Result<LampRule, Fault> {
    let corner = table.need("corner")?.vector()?;
    let value = table.need("sides")?;
    let [u, v] = value.list("[[x, y, z], [x, y, z]]")?;
    let sides = [u.direction()?, v.direction()?];
    let sine = length(cross(unit(sides[0]), unit(sides[1])));
    if sine < LEAST_SINE {
        return value.refuse("two sides that are not parallel");
    }
    Ok(LampRule::Area { corner, sides, power: power(table, "exitance")? })
}

/// Passes on a lamp whose numbers can be computed with.
fn checked(table: &Table<'_>, rule: LampRule) -> Result<LampRule, Fault> {
    let lamp = rule.lamp();
    let way = match lamp {
        Lamp::Point { .. } => [0.0; 3],
        Lamp::Spot { direction, .. } | Lamp::Sun { direction, .. } => direction,
        // Squares of its sides are computed with.
        Lamp::Area { sides: [u, v], .. } => cross(u, v),
    };
    let is_sound = lamp.color().iter().all(|&v| v <= MAX_LIGHT);
    match is_sound && way.iter().all(|v| v.is_finite()) {
        true => Ok(rule),
        false => fault(table.at, "its light is above 1e30: numbers are too large or too small"),
    }
}

fn sun(table: &Table<'_>) -> Result<Sun, Fault> {
    let to = match table.one_of(&["direction", "azimuth"])? {
        to if to.key() == "direction" => match table.get("elevation") {
            None => ToSun::Direction(to.direction()?),
            Some(v) => return fault(v.at(), "`elevation` beside `direction`; give one of them"),
        },
        azimuth => ToSun::Angles {
            azimuth: azimuth.number_in("-360 to 360", |v| v.abs() <= 360.0)?,
            elevation: table.need("elevation")?.number_in("-90 to 90", |v| v.abs() <= 90.0)?,
        },
    };
    let irradiance = table.need("irradiance")?.color(AMOUNT, is_amount)?;
    Ok(Sun { to, irradiance })
}

fn sky(table: Table<'_>) -> Result<Sky, Fault> {
    let radiance = table.need("radiance")?.color(AMOUNT, is_amount)?;
    let up = table.get("up").map_or(Ok([0.0, 0.0, 1.0]), |up| up.direction())?;
    Ok(Sky { radiance, up })
}
