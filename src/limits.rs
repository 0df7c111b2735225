//! What a run may use: threads and memory. They never decide content.

use std::str::FromStr;

use crate::Error;

/// Threads and memory of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Threads; 0 takes as many as the machine has.
    pub threads: usize,
    /// Anonymous memory to hold at most, less 16 MiB and 2 MiB a thread. [D-9]
    pub memory_bytes: u64,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits { threads: 0, memory_bytes: 1 << 30 }
    }
}

/// More threads than any machine has cores for; a hundred thousand would eat its memory.
pub const MAX_THREADS: usize = 1024;

impl Limits {
    /// Refuses a number of threads that can only be a slip.
    ///
    /// # Errors
    /// Where there are more than 1024.
    pub(crate) fn check(&self) -> Result<(), Error> {
        match self.threads {
            0..=MAX_THREADS => Ok(()),
            n => Err(Error::Config(format!("threads = {n}: it must be at most {MAX_THREADS}"))),
        }
    }

    /// Runs a job on a pool of so many threads.
    ///
    /// # Errors
    /// Where there are more than 1024, or the system has no room for them.
    pub fn run<T: Send>(&self, job: impl FnOnce() -> T + Send) -> Result<T, Error> {
        self.check()?;
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(self.threads)
            .build()
            .map_err(|e| Error::Threads(e.to_string()))?;
        Ok(pool.install(job))
    }
}

/// A size as users write it: `64MiB`, `1GiB`, `500MB`, `1073741824`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Size(pub u64);

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Size, String> {
        let at = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
        let (number, unit) = text.split_at(at);
        let factor: u64 = match unit.trim().to_ascii_lowercase().as_str() {
            "" | "b" => 1,
            "k" | "kib" => 1 << 10,
            "m" | "mib" => 1 << 20,
            "g" | "gib" => 1 << 30,
            "t" | "tib" => 1 << 40,
            "kb" => 1_000,
            "mb" => 1_000_000,
            "gb" => 1_000_000_000,
            "tb" => 1_000_000_000_000,
            _ => return Err(format!("unknown unit {unit:?}; write for example 512MiB or 2GiB")),
        };
        let value: f64 = number
            .parse()
            .map_err(|_| "write a number and a unit, for example 512MiB".to_owned())?;
        Ok(Size((value * factor as f64) as u64))
    }
}

/// Reads `--memory`: a size of at least 64 MiB.
pub fn parse_memory(text: &str) -> Result<u64, String> {
    let Size(bytes) = text.parse()?;
    if bytes < pvmap_store::memory::MIN_BYTES {
        return Err("the least is 64MiB".to_owned());
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_as_users_write_them() {
        for (text, bytes) in
            [("64MiB", 64 << 20), ("1GiB", 1 << 30), ("1.5g", 3 << 29), ("100MB", 100_000_000)]
        {
            assert_eq!(parse_memory(text), Ok(bytes), "{text}");
        }
        for bad in ["", "GiB", "1 parsec", "63MiB", "-1GiB"] {
            assert!(parse_memory(bad).is_err(), "{bad}");
        }
    }
}
