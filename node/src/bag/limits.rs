//! How much a bag may make us allocate, whatever its headers claim.

/// Largest MCAP chunk, compressed or not. Writers close chunks at 1-10 MB; one picture or cloud larger than that still fits.
pub const MAX_CHUNK_BYTES: u64 = 512 << 20;

/// Largest message: a 100-megapixel rgb8 picture is 300 MB.
pub const MAX_MESSAGE_BYTES: u64 = 512 << 20;

/// Largest MCAP record that is not a chunk, a message or an attachment (schemas, channels, statistics).
pub const MAX_RECORD_BYTES: u64 = 64 << 20;

/// Largest MCAP summary section read at once: 200 bytes per chunk, so millions of chunks.
pub const MAX_SUMMARY_BYTES: u64 = 512 << 20;

/// Decompressed chunks held at a time; beyond it, chunks whose messages come later are dropped and read again.
pub const CHUNK_CACHE_BYTES: usize = 512 << 20;

/// Largest metadata.yaml.
pub const MAX_METADATA_BYTES: u64 = 16 << 20;

/// A compressed file may unpack to this many times its size ...
pub const MAX_UNPACK_RATIO: u64 = 200;

/// ... plus this much, which lets small bags of very regular pictures through.
pub const UNPACK_ALLOWANCE_BYTES: u64 = 256 << 20;

/// Largest database copied aside because it has a write-ahead log that was never merged.
pub const MAX_WAL_COPY_BYTES: u64 = 16 << 30;

/// First reservation for decompressed data: claims beyond it are believed as the bytes arrive.
pub const FIRST_RESERVATION_BYTES: u64 = 8 << 20;

/// Problem lines kept per bag.
pub const MAX_PROBLEMS: usize = 200;
