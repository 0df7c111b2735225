//! Little-endian fields in and out of fixed records.

/// Writes fields one after another into a record.
#[derive(Debug)]
pub struct FieldWriter<'a> {
    bytes: &'a mut [u8],
    at: usize,
}

/// Reads fields one after another out of a record.
#[derive(Debug)]
pub struct FieldReader<'a> {
    bytes: &'a [u8],
    at: usize,
}

macro_rules! fields {
    ($($name:ident: $type:ty),*) => {
        impl FieldWriter<'_> {
            $(
                #[doc = concat!("Writes one `", stringify!($type), "`.")]
                #[inline(always)]
                pub fn $name(&mut self, value: $type) {
                    self.raw(&value.to_le_bytes());
                }
            )*
        }
        impl FieldReader<'_> {
            $(
                #[doc = concat!("Reads one `", stringify!($type), "`.")]
                #[inline(always)]
                pub fn $name(&mut self) -> $type {
                    <$type>::from_le_bytes(self.raw())
                }
            )*
        }
    };
}

fields!(u8: u8, i8: i8, u16: u16, i16: i16, u32: u32, i32: i32, u64: u64, i64: i64, u128: u128,
    f32: f32, f64: f64);

impl<'a> FieldWriter<'a> {
    /// Starts at the first byte of a record. Bytes that are not written keep their value.
    pub fn new(bytes: &'a mut [u8]) -> FieldWriter<'a> {
        FieldWriter { bytes, at: 0 }
    }

    /// Writes the three components of a vector.
    #[inline(always)]
    pub fn three<T>(&mut self, [x, y, z]: [T; 3], put: fn(&mut Self, T)) {
        put(self, x);
        put(self, y);
        put(self, z);
    }

    /// Writes bytes as they are.
    #[inline(always)]
    pub fn raw(&mut self, raw: &[u8]) {
        self.bytes[self.at..self.at + raw.len()].copy_from_slice(raw);
        self.at += raw.len();
    }
}

impl<'a> FieldReader<'a> {
    /// Starts at the first byte of a record.
    #[inline(always)]
    pub fn new(bytes: &'a [u8]) -> FieldReader<'a> {
        FieldReader { bytes, at: 0 }
    }

    /// Reads bytes as they are.
    #[inline(always)]
    pub fn raw<const N: usize>(&mut self) -> [u8; N] {
        let (head, _) = self.bytes[self.at..].split_first_chunk().expect("record size is fixed");
        self.at += N;
        *head
    }

    /// Reads the three components of a vector.
    #[inline(always)]
    pub fn three<T>(&mut self, get: fn(&mut Self) -> T) -> [T; 3] {
        [get(self), get(self), get(self)]
    }

    /// Says whether all bytes that were not read are zero, as reserved fields must be.
    #[inline(always)]
    pub fn rest_is_zero(&self) -> bool {
        self.bytes[self.at..].iter().all(|&b| b == 0)
    }
}
