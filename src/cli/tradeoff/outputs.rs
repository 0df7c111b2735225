//! The files that a sweep writes.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use pvmap::tradeoff::plot;
use pvmap::{Error, StoreError, TableFile, begin_table, is_stdout};

use super::super::refuse_input;
use super::{Args, source};

/// The files that were asked for, begun before any work.
pub(super) struct Outputs {
    csv: Option<TableFile>,
    svg: Option<TableFile>,
}

impl Outputs {
    pub(super) fn begin(args: &Args, csv_start: &'static str) -> Result<Outputs, Error> {
        let on_stdout = |path: &Option<PathBuf>| path.as_deref().is_some_and(is_stdout);
        let n_on_stdout = [args.json, on_stdout(&args.csv), on_stdout(&args.svg)];
        if n_on_stdout.into_iter().filter(|&is| is).count() > 1 {
            let message = "standard output has room for one of --json, --csv - and --svg -";
            return Err(Error::Usage(message.to_owned()));
        }
        let inputs = source::inputs(args);
        for output in args.csv.iter().chain(&args.svg).filter(|path| !is_stdout(path)) {
            refuse_input(output, &inputs)?;
        }
        if args.csv.is_some() && args.csv == args.svg {
            return Err(Error::Usage("--csv and --svg cannot be one file".to_owned()));
        }
        let begin = |path: &Option<PathBuf>, start| {
            path.as_deref().map(|path| begin_table(path, start, args.overwrite)).transpose()
        };
        Ok(Outputs { csv: begin(&args.csv, csv_start)?, svg: begin(&args.svg, plot::START)? })
    }

    /// Says whether one of them is what standard output is for.
    fn are_stdout(&self) -> bool {
        self.csv.iter().chain(&self.svg).any(|file| is_stdout(file.path()))
    }

    /// Writes them, and the answer where standard output is free for it. Of a sweep that was
    /// stopped after some rows these are printed, and no file is there in part: it may have taken
    /// an hour.
    pub(super) fn finish(
        self,
        (measured, has_rows): (Result<(), Error>, bool),
        csv: impl FnOnce(&mut dyn Write) -> io::Result<()>,
        drawing: impl FnOnce() -> String,
        print: impl FnOnce(bool) -> io::Result<()>,
    ) -> anyhow::Result<()> {
        let is_free = !self.are_stdout();
        if let Err(e) = measured {
            if matches!(e, Error::Store(StoreError::Interrupted)) && has_rows && is_free {
                print(true)?;
            }
            return Err(e.into());
        }
        let mut closed = Vec::new();
        if let Some(mut file) = self.csv {
            let path = file.path().to_path_buf();
            csv(&mut file).map_err(|e| failed(&path, e))?;
            closed.extend(file.close()?);
        }
        if let Some(mut file) = self.svg {
            let path = file.path().to_path_buf();
            file.write_all(drawing().as_bytes()).map_err(|e| failed(&path, e))?;
            closed.extend(file.close()?);
        }
        for file in closed {
            file.publish(false)?;
        }
        if is_free {
            print(false)?;
        }
        Ok(())
    }
}

fn failed(path: &Path, e: io::Error) -> Error {
    StoreError::io(path, "write", e).into()
}
