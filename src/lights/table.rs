//! Tables of a TOML text whose values know where they stand.

use std::fmt;
use std::ops::Range;

use toml::de::{DeTable, DeValue};

use super::rules::{Rgb, Vector};

/// What is wrong with a text, and at which of its bytes.
#[derive(Debug)]
pub(super) struct Fault {
    pub(super) at: usize,
    pub(super) what: String,
}

/// The longest piece of a text that a message shows.
const MAX_SHOWN: usize = 40;

/// Says something is wrong at a byte.
pub(super) fn fault<T>(at: usize, what: impl Into<String>) -> Result<T, Fault> {
    Err(Fault { at, what: what.into() })
}

/// A table of which all keys are known.
#[derive(Debug, Clone, Copy)]
pub(super) struct Table<'a> {
    text: &'a str,
    entries: &'a DeTable<'a>,
    /// The byte it begins at.
    pub(super) at: usize,
    /// What it is called, as it is written: `[[glow]]`.
    header: Header<'a>,
}

/// The key of a table, and whether there may be several.
#[derive(Debug, Clone, Copy)]
struct Header<'a> {
    key: &'a str,
    is_list: bool,
}

impl fmt::Display for Header<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.key, self.is_list) {
            ("", _) => write!(f, "the file"),
            (key, true) => write!(f, "this [[{key}]]"),
            (key, false) => write!(f, "this [{key}]"),
        }
    }
}

/// A value and the key it stands under.
#[derive(Debug, Clone)]
pub(super) struct Value<'a> {
    text: &'a str,
    key: &'a str,
    value: &'a DeValue<'a>,
    span: Range<usize>,
}

impl<'a> Table<'a> {
    /// Takes the table that is a whole text; a key that is not `known` is a fault.
    pub(super) fn whole(
        text: &'a str,
        entries: &'a DeTable<'a>,
        known: &[&str],
    ) -> Result<Table<'a>, Fault> {
        Table::of(text, entries, (0, Header { key: "", is_list: false }), known)
    }

    fn of(
        text: &'a str,
        entries: &'a DeTable<'a>,
        (at, header): (usize, Header<'a>),
        known: &[&str],
    ) -> Result<Table<'a>, Fault> {
        let unknown = entries.keys().filter(|key| !known.contains(&key.get_ref().as_ref()));
        let Some(first) = unknown.min_by_key(|key| key.span().start) else {
            return Ok(Table { text, entries, at, header });
        };
        let key = first.get_ref();
        let nearest = known.iter().min_by_key(|name| n_edits(key, name)).unwrap_or(&"");
        fault(first.span().start, format!("unknown key `{key}`; the nearest known is `{nearest}`"))
    }

    /// Gives the value of a key.
    pub(super) fn get(&self, key: &'a str) -> Option<Value<'a>> {
        let value = self.entries.get(key)?;
        Some(Value { text: self.text, key, value: value.get_ref(), span: value.span() })
    }

    /// Gives the value of a key that has to be there.
    pub(super) fn need(&self, key: &'a str) -> Result<Value<'a>, Fault> {
        match self.get(key) {
            Some(value) => Ok(value),
            None => fault(self.at, format!("`{key}` is missing")),
        }
    }

    /// Gives the value of the one of `keys` that is there.
    pub(super) fn one_of(&self, keys: &[&'a str]) -> Result<Value<'a>, Fault> {
        let mut found: Vec<Value<'_>> = keys.iter().filter_map(|key| self.get(key)).collect();
        found.sort_by_key(|value| value.span.start);
        match found.as_slice() {
            [one] => Ok(one.clone()),
            [] => fault(self.at, self.has_none_of(keys)),
            [first, second, ..] => {
                let (a, b) = (first.key, second.key);
                fault(second.span.start, format!("`{b}` beside `{a}`; give one of them"))
            }
        }
    }
}

impl Table<'_> {
    fn has_none_of(&self, keys: &[&str]) -> String {
        match keys {
            [a, b] => format!("{} has neither `{a}` nor `{b}`", self.header),
            _ => format!("{} has none of {}; give one", self.header, listed(keys)),
        }
    }
}

impl<'a> Value<'a> {
    /// Gives the key.
    pub(super) fn key(&self) -> &'a str {
        self.key
    }

    /// Gives the first of its bytes.
    pub(super) fn at(&self) -> usize {
        self.span.start
    }

    /// Says what it must be, and is not.
    pub(super) fn refuse<T>(&self, must: &str) -> Result<T, Fault> {
        let written = self.text.get(self.span.clone()).unwrap_or_default();
        let line = written.split_whitespace().collect::<Vec<_>>().join(" ");
        let shown = match line.char_indices().nth(MAX_SHOWN) {
            Some((end, _)) => format!("{}…", &line[..end]),
            None => line,
        };
        fault(self.at(), format!("{} = {shown}: it must be {must}", self.key))
    }

    /// Reads a table with some known keys.
    pub(super) fn table(&self, known: &[&str]) -> Result<Table<'a>, Fault> {
        match self.value {
            DeValue::Table(entries) => Table::of(self.text, entries, self.headed(false), known),
            _ => fault(self.at(), format!("`{}` is there once: write [{0}]", self.key)),
        }
    }

    /// Reads tables with some known keys, `[[key]]`.
    pub(super) fn tables(&self, known: &[&str]) -> Result<Vec<Table<'a>>, Fault> {
        let one = |item: &Value<'a>| match item.value {
            DeValue::Table(entries) => {
                Some(Table::of(self.text, entries, item.headed(true), known))
            }
            _ => None,
        };
        let tables = self.items().and_then(|items| items.iter().map(one).collect());
        match tables {
            Some(tables) => tables,
            None => {
                let what = format!("there may be several: write [[{}]]", self.key);
                fault(self.at(), format!("{what}, with two brackets"))
            }
        }
    }

    fn headed(&self, is_list: bool) -> (usize, Header<'a>) {
        (self.at(), Header { key: self.key, is_list })
    }

    fn items(&self) -> Option<Vec<Value<'a>>> {
        let of = |item: &'a toml::Spanned<DeValue<'a>>| Value {
            value: item.get_ref(),
            span: item.span(),
            ..self.clone()
        };
        Some(self.value.as_array()?.iter().map(of).collect())
    }

    /// Reads so many values.
    pub(super) fn list<const N: usize>(&self, must: &str) -> Result<[Value<'a>; N], Fault> {
        match self.items().map(<[Value<'a>; N]>::try_from) {
            Some(Ok(items)) => Ok(items),
            _ => self.refuse(must),
        }
    }

    /// Reads so many numbers.
    pub(super) fn numbers<const N: usize>(&self, must: &str) -> Result<[f64; N], Fault> {
        let mut numbers = [0.0; N];
        for (number, item) in numbers.iter_mut().zip(self.list::<N>(must)?) {
            *number = item.number()?;
        }
        Ok(numbers)
    }

    /// Reads a place or a direction.
    pub(super) fn vector(&self) -> Result<Vector, Fault> {
        self.numbers("[x, y, z]")
    }

    /// Reads a direction.
    pub(super) fn direction(&self) -> Result<Vector, Fault> {
        match self.vector()? {
            [0.0, 0.0, 0.0] => self.refuse("a direction, of any length but 0"),
            v => Ok(v),
        }
    }

    /// Reads a number, an integer or a float.
    pub(super) fn number(&self) -> Result<f64, Fault> {
        let number = match self.value {
            DeValue::Float(float) => float.as_str().parse().ok(),
            DeValue::Integer(whole) => {
                i64::from_str_radix(whole.as_str(), whole.radix()).ok().map(|v| v as f64)
            }
            _ => None,
        };
        match number {
            // A zero without a sign: it is told and compared.
            Some(v) if f64::is_finite(v) => Ok(v + 0.0),
            _ => self.refuse("a finite number"),
        }
    }

    /// Reads a number in a range.
    pub(super) fn number_in(&self, must: &str, is_in: fn(f64) -> bool) -> Result<f64, Fault> {
        let v = self.number()?;
        if is_in(v) { Ok(v) } else { self.refuse(must) }
    }

    /// Reads a whole number of 0 to 255.
    pub(super) fn byte(&self) -> Result<u8, Fault> {
        let byte = self.value.as_integer().map(|v| u8::from_str_radix(v.as_str(), v.radix()));
        match byte {
            Some(Ok(v)) => Ok(v),
            _ => self.refuse("a whole number of 0 to 255"),
        }
    }

    /// Reads a colour of which each part is in a range: a number for grey, three in linear light,
    /// or "#rrggbb".
    pub(super) fn color(&self, must: &str, is_in: fn(f64) -> bool) -> Result<Rgb, Fault> {
        let form = "a number, [red, green, blue] or \"#rrggbb\"";
        match self.value {
            DeValue::String(hex) => match linear_of_hex(hex) {
                Some(color) => Ok(color),
                None => self.refuse(form),
            },
            DeValue::Array(_) => {
                let [r, g, b] = self.list(form)?;
                Ok([
                    r.number_in(must, is_in)?,
                    g.number_in(must, is_in)?,
                    b.number_in(must, is_in)?,
                ])
            }
            DeValue::Integer(_) | DeValue::Float(_) => Ok([self.number_in(must, is_in)?; 3]),
            _ => self.refuse(form),
        }
    }

    /// Gives a text; none where it is something else.
    pub(super) fn text(&self) -> Option<&'a str> {
        self.value.as_str()
    }

    /// Reads a `true` that may be left out and cannot be `false`.
    pub(super) fn is_true(&self) -> Result<(), Fault> {
        if self.value.as_bool() == Some(true) { Ok(()) } else { self.refuse("true") }
    }
}

/// Gives linear light of a colour "#rrggbb", the very number that surfels of that colour have.
fn linear_of_hex(hex: &str) -> Option<Rgb> {
    let digits = hex.strip_prefix('#').filter(|d| d.len() == 6)?;
    let digits = digits.bytes().all(|b| b.is_ascii_hexdigit()).then_some(digits)?;
    let v = u32::from_str_radix(digits, 16).ok()?;
    let light = |byte: u32| pvmap_octree::cut::linear((byte & 255) as u16 * 257);
    Some([v >> 16, v >> 8, v].map(|byte| f64::from(light(byte)) / 65535.0))
}

fn listed(keys: &[&str]) -> String {
    keys.iter().map(|key| format!("`{key}`")).collect::<Vec<_>>().join(", ")
}

/// Counts the letters to put in, take out or change to make one word of another.
fn n_edits(a: &str, b: &str) -> usize {
    let mut row: Vec<usize> = (0..=b.chars().count()).collect();
    for (i, x) in a.chars().enumerate() {
        let mut before = std::mem::replace(&mut row[0], i + 1);
        for (j, y) in b.chars().enumerate() {
            let changed = before + usize::from(x != y);
            before = row[j + 1];
            row[j + 1] = changed.min(row[j] + 1).min(before + 1);
        }
    }
    row[b.chars().count()]
}
