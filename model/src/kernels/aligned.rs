//! Buffers that start on a cache line, so that no vector load of a packed panel crosses one.

/// Bytes in a cache line.
const LINE: usize = 64;

/// An `f32` buffer aligned to 64 bytes.
#[derive(Default)]
pub(crate) struct Aligned {
    values: Vec<f32>,
    start: usize,
    len: usize,
}

impl Aligned {
    /// `len` zeros (pages are touched by whoever writes them first).
    pub(crate) fn zeroed(len: usize) -> Self {
        let spare = LINE / size_of::<f32>();
        let values = vec![0f32; len + spare];
        // An address that cannot be aligned (never seen, but allowed) only costs speed.
        let start = values.as_ptr().align_offset(LINE);
        Self { values, start: if start <= spare { start } else { 0 }, len }
    }

    /// `len` floats of whatever was there before, from a buffer that only ever grows.
    pub(crate) fn at_least(&mut self, len: usize) -> &mut [f32] {
        if self.len < len {
            *self = Self::zeroed(len);
        }
        &mut self.as_mut_slice()[..len]
    }

    pub(crate) fn as_slice(&self) -> &[f32] {
        &self.values[self.start..self.start + self.len]
    }

    pub(crate) fn as_mut_slice(&mut self) -> &mut [f32] {
        &mut self.values[self.start..self.start + self.len]
    }
}

impl std::fmt::Debug for Aligned {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Aligned({} floats)", self.len)
    }
}
