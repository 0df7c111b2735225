//! Tables: items of one size that are made once, changed in place and asked in any order, in memory
//! or, where the budget does not allow that, in a mapped temporary file. Pages of a file are not
//! anonymous memory ([D-9]): the system may write them out and use their room for others.
//!
//! [`Stack`]s are parts of growing tables: what they held is the system's again when they end.

use std::alloc::{Layout, handle_alloc_error};
use std::fs::File;
use std::io::{self, Write};
use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};
use std::path::Path;

use memmap2::MmapMut;

use crate::StoreError;

/// Zeroes written at once.
const CHUNK_BYTES: usize = 1 << 16;

/// A fixed number of items.
#[derive(Debug)]
pub struct Table<T: Copy> {
    place: Place<T>,
}

#[derive(Debug)]
enum Place<T> {
    Held(Vec<T>),
    Mapped(MappedItems<T>),
}

impl<T: Copy> Table<T> {
    /// Makes a table of `n_items` times `item`: in a nameless file of `folder`, or in memory where
    /// none is given.
    ///
    /// # Errors
    /// Where the file cannot be made or mapped, or the disk is full.
    pub fn new(n_items: usize, item: T, folder: Option<&Path>) -> Result<Table<T>, StoreError> {
        let place = match folder {
            // No file of no bytes can be mapped.
            Some(folder) if n_items * size_of::<T>() > 0 => {
                Place::Mapped(MappedItems::new(n_items, item, folder)?)
            }
            _ => Place::Held(vec![item; n_items]),
        };
        Ok(Table { place })
    }
}

impl<T: Copy> Deref for Table<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        match &self.place {
            Place::Held(items) => items,
            Place::Mapped(items) => items.all(),
        }
    }
}

impl<T: Copy> DerefMut for Table<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        match &mut self.place {
            Place::Held(items) => items,
            Place::Mapped(items) => items.all_mut(),
        }
    }
}

/// Items in a file that nobody else can open: it has no name.
#[derive(Debug)]
struct MappedItems<T> {
    map: MmapMut,
    n_items: usize,
    items: PhantomData<T>,
}

impl<T: Copy> MappedItems<T> {
    fn new(n_items: usize, item: T, folder: &Path) -> Result<MappedItems<T>, StoreError> {
        let fail = |e| StoreError::io(folder, "make a temporary file in", e);
        let mut file = tempfile::tempfile_in(folder).map_err(fail)?;
        fill(&mut file, n_items * size_of::<T>())
            .map_err(|e| StoreError::io(folder, "write a temporary file in", e))?;
        // SAFETY: the file has no name and its handle ends here, so nobody else writes to it or
        // cuts it short. A disk that fails sends SIGBUS, as with every mapped file.
        let mut map = unsafe { MmapMut::map_mut(&file) }.map_err(fail)?;
        assert!(size_of::<T>() * n_items <= map.len() && align_of::<T>() <= 4096, "room for all");
        let first = map.as_mut_ptr().cast::<T>();
        for i in 0..n_items {
            // SAFETY: the map is at the start of a page and holds all `n_items`, as was asserted.
            unsafe { first.add(i).write(item) };
        }
        Ok(MappedItems { map, n_items, items: PhantomData })
    }

    fn all(&self) -> &[T] {
        // SAFETY: `new` wrote that many whole items there, and only as items are they changed;
        // they borrow the map, which stays where it is.
        unsafe { std::slice::from_raw_parts(self.map.as_ptr().cast(), self.n_items) }
    }

    fn all_mut(&mut self) -> &mut [T] {
        // SAFETY: as in `all`, and the map is borrowed for them alone.
        unsafe { std::slice::from_raw_parts_mut(self.map.as_mut_ptr().cast(), self.n_items) }
    }
}

/// At most so many items as were asked for, in pages of their own. Unlike what an allocator takes
/// back, pages are given to the system at once; those that were never used cost nothing.
#[derive(Debug)]
pub struct Stack<T: Copy> {
    map: MmapMut,
    n_items: usize,
    max_items: usize,
    items: PhantomData<T>,
}

impl<T: Copy> Stack<T> {
    /// Makes an empty stack with room for `max_items`, at least one. Without memory the process
    /// ends as where any other allocation fails.
    ///
    /// # Panics
    /// Where there is no room to ask for.
    pub fn new(max_items: usize) -> Stack<T> {
        let layout = Layout::array::<T>(max_items).expect("room that can be addressed");
        assert!(layout.size() > 0 && layout.align() <= 4096, "items that fit on pages");
        let map = MmapMut::map_anon(layout.size()).unwrap_or_else(|_| handle_alloc_error(layout));
        Stack { map, n_items: 0, max_items, items: PhantomData }
    }

    /// Says whether another item has no room.
    #[inline]
    pub fn is_full(&self) -> bool {
        self.n_items == self.max_items
    }

    /// Adds an item.
    ///
    /// # Panics
    /// Where it is full.
    #[inline]
    pub fn push(&mut self, item: T) {
        assert!(!self.is_full(), "a stack with room");
        // SAFETY: the map is at the start of a page and holds `max_items`, more than there are.
        unsafe { self.map.as_mut_ptr().cast::<T>().add(self.n_items).write(item) };
        self.n_items += 1;
    }
}

impl<T: Copy> Deref for Stack<T> {
    type Target = [T];

    #[inline]
    fn deref(&self) -> &[T] {
        // SAFETY: `push` wrote so many whole items there; they borrow the map.
        unsafe { std::slice::from_raw_parts(self.map.as_ptr().cast(), self.n_items) }
    }
}

impl<T: Copy> DerefMut for Stack<T> {
    #[inline]
    fn deref_mut(&mut self) -> &mut [T] {
        // SAFETY: as in `deref`, and the map is borrowed for them alone.
        unsafe { std::slice::from_raw_parts_mut(self.map.as_mut_ptr().cast(), self.n_items) }
    }
}

/// Writes zeroes: the disk gives the room now or says that it is full, not later by a signal.
fn fill(file: &mut File, n_bytes: usize) -> io::Result<()> {
    let zeroes = [0; CHUNK_BYTES];
    let mut rest = n_bytes;
    while rest > 0 {
        let n = rest.min(CHUNK_BYTES);
        file.write_all(&zeroes[..n])?;
        rest -= n;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn d9_a_table_in_a_file_is_as_one_in_memory() {
        let folder = tempfile::tempdir().unwrap();
        for n_items in [0, 1, 100_000] {
            let place = |i: usize| [i as u64, 7 * i as u64, u64::MAX - i as u64];
            let mut tables =
                [None, Some(folder.path())].map(|f| Table::new(n_items, place(3), f).unwrap());
            for table in &mut tables {
                assert!(table.len() == n_items && table.iter().all(|t| *t == place(3)));
                table.iter_mut().enumerate().for_each(|(i, t)| *t = place(i));
            }
            let [held, mapped] = tables;
            assert!(held[..] == mapped[..]);
            assert!(mapped.iter().enumerate().all(|(i, t)| *t == place(i)));
            assert_eq!(matches!(mapped.place, Place::Mapped(_)), n_items > 0);
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "no names");
    }

    #[test]
    fn a_stack_holds_what_was_pushed() {
        let place = |i: u32| (i, u64::from(i) << 32);
        let mut stack = Stack::new(3000);
        while !stack.is_full() {
            stack.push(place(stack.len() as u32));
        }
        assert!(stack.iter().zip(0..).all(|(item, i)| *item == place(i)));
        stack[17].1 = 5;
        assert_eq!((stack.len(), stack[16..18].to_vec()), (3000, vec![place(16), (17, 5)]));
    }

    #[test]
    fn f18_a_table_without_room_is_an_error() {
        let nowhere = Path::new("/nowhere/at/all");
        assert!(Table::new(1, 0u8, Some(nowhere)).is_err());
    }
}
