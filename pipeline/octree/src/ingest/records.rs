//! Records moved from buffer to buffer.
//!
//! A copy whose size the compiler knows is a few vector moves; one it does not know is a call that
//! takes longer than they. So records are moved in whole steps of 16 bytes, and what is written
//! past a record's end is overwritten by the next.

/// Bytes behind the last record of every buffer that records are copied from or to.
pub(crate) const SLACK_BYTES: usize = 16;

/// Calls a function with `N` = the record's bytes in whole steps of 16, or with 0 where they are
/// many: `in_steps!(record_bytes, function::<N>(arguments))`.
macro_rules! in_steps {
    ($record_bytes:expr, $($path:ident).+::<N>($($argument:expr),*)) => {
        match $record_bytes.div_ceil(16) {
            1 => $($path).+::<16>($($argument),*),
            2 => $($path).+::<32>($($argument),*),
            3 => $($path).+::<48>($($argument),*),
            4 => $($path).+::<64>($($argument),*),
            _ => $($path).+::<0>($($argument),*),
        }
    };
}
pub(crate) use in_steps;

/// Copies the record at the start of `from` to the start of `to`; both have [`SLACK_BYTES`] behind
/// it. `N` is what [`in_steps`] says.
#[inline(always)]
pub(crate) fn copy_record<const N: usize>(from: &[u8], to: &mut [u8], record_bytes: usize) {
    let n = if N == 0 { record_bytes } else { N };
    to[..n].copy_from_slice(&from[..n]);
}

/// Copies the records at the given indices of `from`, one after another.
pub(crate) fn gather(from: &[u8], indices: &[u64], record_bytes: usize, to: &mut Vec<u8>) {
    let n_bytes = indices.len() * record_bytes;
    to.resize((n_bytes + SLACK_BYTES).max(to.len()), 0);
    in_steps!(record_bytes, gather_steps::<N>(from, indices, record_bytes, to));
    to.truncate(n_bytes);
}

fn gather_steps<const N: usize>(from: &[u8], indices: &[u64], record_bytes: usize, to: &mut [u8]) {
    for (at, &i) in (0..).step_by(record_bytes).zip(indices) {
        copy_record::<N>(&from[i as usize * record_bytes..], &mut to[at..], record_bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_of_every_size_arrive_whole() {
        for record_bytes in 1..100 {
            let n_bytes = 10 * record_bytes;
            let mut from: Vec<u8> = (0..n_bytes).map(|i| (i % 251) as u8).collect();
            let indices = [7, 0, 9, 3];
            let expected: Vec<u8> = indices
                .iter()
                .flat_map(|&i| &from[i as usize * record_bytes..][..record_bytes])
                .copied()
                .collect();
            from.resize(n_bytes + SLACK_BYTES, 255);
            let mut found = vec![1; 5];
            gather(&from, &indices, record_bytes, &mut found);
            assert_eq!(found, expected, "{record_bytes} bytes");
        }
    }
}
