//! The native files of the map: one per tile and an index over them.
//!
//! A file is a magic word, a version, the payload's length and CRC-32, and the payload. A tile's payload is its
//! fields as little-endian columns, the bytes of equal significance together (neighbouring numbers share their high
//! bytes), compressed with zstd. Nothing is rounded: a tile that was away on disk is the tile it was.

use std::io::Read;
use std::path::Path;

use glam::{DVec3, Vec3};

use super::cell::{Cell, MAX_WEIGHT, SUPPORT_MAX};
use super::error::MapError;
use super::tile::{Tile, TileIndex};
use super::voxel::{LEVELS, MAX_CELLS, MAX_PER_EDGE, level_of};

const TILE_MAGIC: [u8; 8] = *b"STRMTILE";
const INDEX_MAGIC: [u8; 8] = *b"STRMMAPX";
/// Raised when the layout changes; other versions are refused.
const VERSION: u32 = 1;
/// Magic, version, payload length, CRC-32.
const HEAD: usize = 8 + 4 + 8 + 4;
/// Words of four bytes per cell.
const WORDS: usize = 18;
/// Fast, and within a few per cent of the slower levels on this kind of data.
const ZSTD_LEVEL: i32 = 1;
/// Largest file read at all, bytes: a full tile.
const MAX_FILE: u64 = (MAX_CELLS * WORDS * 4) as u64;

/// One tile's line of the index.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct IndexEntry {
    pub index: TileIndex,
    pub revision: u64,
    pub cells: u32,
    pub crc: u32,
}

/// The index file: what the map is made of.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct MapIndex {
    pub tile_m: f64,
    pub voxel_m: f64,
    pub origin: DVec3,
    /// Windows fused so far.
    pub revision: u64,
    /// Stamp of the first window, nanoseconds.
    pub first_stamp_ns: i64,
    pub entries: Vec<IndexEntry>,
}

fn sealed(magic: [u8; 8], payload: &[u8]) -> (Vec<u8>, u32) {
    let crc = crc32fast::hash(payload);
    let mut out = Vec::with_capacity(HEAD + payload.len());
    out.extend(magic);
    out.extend(VERSION.to_le_bytes());
    out.extend((payload.len() as u64).to_le_bytes());
    out.extend(crc.to_le_bytes());
    out.extend(payload);
    (out, crc)
}

/// Reads a file and checks all that its head promises; the payload and its checksum.
fn opened(path: &Path, magic: [u8; 8]) -> Result<(Vec<u8>, u32), MapError> {
    let damaged = |reason: String| MapError::Damaged { path: path.to_owned(), reason };
    let size = std::fs::metadata(path).map_err(MapError::io(path))?.len();
    if size > MAX_FILE {
        return Err(damaged(format!("{size} bytes, more than any such file has ({MAX_FILE})")));
    }
    let mut bytes = std::fs::read(path).map_err(MapError::io(path))?;
    if bytes.len() < HEAD || bytes[..8] != magic {
        return Err(damaged("not such a file, or cut short; restore it, or load the rest without it".into()));
    }
    let version = le_u32(&bytes, 8);
    if version != VERSION {
        return Err(damaged(format!("version {version} of the format, this program reads {VERSION}")));
    }
    let (promised, crc) = (le_u64(&bytes, 12), le_u32(&bytes, 20));
    if promised != (bytes.len() - HEAD) as u64 {
        return Err(damaged(format!("promises {promised} bytes, has {}; it was cut short", bytes.len() - HEAD)));
    }
    bytes.drain(..HEAD);
    let found = crc32fast::hash(&bytes);
    if found != crc {
        return Err(damaged(format!("checksum {found:08x} instead of {crc:08x}; its bytes were changed")));
    }
    Ok((bytes, crc))
}

/// Four bytes at `at`; zeros where there are none.
fn le_u32(bytes: &[u8], at: usize) -> u32 {
    bytes.get(at..at + 4).and_then(|b| b.try_into().ok()).map_or(0, u32::from_le_bytes)
}

fn le_u64(bytes: &[u8], at: usize) -> u64 {
    u64::from(le_u32(bytes, at)) | u64::from(le_u32(bytes, at + 4)) << 32
}

fn words(c: &Cell) -> [u32; WORDS] {
    let f = f32::to_bits;
    let ([px, py, pz], [r, g, b]) = (c.position.to_array().map(f), c.color.to_array().map(f));
    let [xx, xy, xz, yy, yz, zz] = c.cov.map(f);
    let (o, w, s) = (f(c.opacity), f(c.weight), f(c.support));
    [c.key, c.born_ms, c.seen_ms, px, py, pz, xx, xy, xz, yy, yz, zz, r, g, b, o, w, s]
}

/// A cell from its words; none when a number is not one that the map writes.
fn cell(w: &[u32; WORDS]) -> Option<Cell> {
    let f = |i: usize| f32::from_bits(w[i]);
    let c = Cell {
        key: w[0],
        born_ms: w[1],
        seen_ms: w[2],
        position: Vec3::new(f(3), f(4), f(5)),
        cov: [f(6), f(7), f(8), f(9), f(10), f(11)],
        color: Vec3::new(f(12), f(13), f(14)),
        opacity: f(15),
        weight: f(16),
        support: f(17),
    };
    is_sound(&c).then_some(c)
}

/// Whether all numbers of a cell are ones that the map writes.
pub(super) fn is_sound(c: &Cell) -> bool {
    level_of(c.key) < LEVELS
        && c.position.is_finite()
        && c.cov.iter().all(|x| x.is_finite())
        && c.color.is_finite()
        && (0.0..=1.0).contains(&c.opacity)
        && c.weight > 0.0
        && c.weight <= MAX_WEIGHT
        && c.support > 0.0
        && c.support <= SUPPORT_MAX
}

/// A tile's file, and the checksum of its payload.
pub(super) fn encode_tile(tile: &Tile) -> std::io::Result<(Vec<u8>, u32)> {
    let n = tile.cells.len();
    let mut planes = vec![0u8; n * WORDS * 4];
    for (i, c) in tile.cells.iter().enumerate() {
        for (w, word) in words(c).into_iter().enumerate() {
            for (b, byte) in word.to_le_bytes().into_iter().enumerate() {
                planes[(w * 4 + b) * n + i] = byte;
            }
        }
    }
    let mut payload = Vec::new();
    tile.index.iter().for_each(|x| payload.extend(x.to_le_bytes()));
    payload.extend((n as u32).to_le_bytes());
    payload.extend(tile.revision.to_le_bytes());
    payload.extend(tile.stamp_ns.to_le_bytes());
    payload.extend(zstd::encode_all(&planes[..], ZSTD_LEVEL)?);
    Ok(sealed(TILE_MAGIC, &payload))
}

/// Bytes of a tile's payload before the compressed columns.
const TILE_HEAD: usize = 12 + 4 + 8 + 8;

/// Reads a tile's file; it must be the one the index means.
pub(super) fn decode_tile(path: &Path, wanted: &IndexEntry, voxel_m: f64) -> Result<Tile, MapError> {
    let [x, y, z] = wanted.index;
    let damaged = |reason: String| MapError::Damaged {
        path: path.to_owned(),
        reason: format!("tile {x} {y} {z}: {reason}; restore the file, or load the rest without it"),
    };
    let (payload, crc) = opened(path, TILE_MAGIC)?;
    if payload.len() < TILE_HEAD {
        return Err(damaged("cut short".into()));
    }
    let index = [0, 4, 8].map(|at| le_u32(&payload, at) as i32);
    let (cells, revision, stamp_ns) = (le_u32(&payload, 12), le_u64(&payload, 16), le_u64(&payload, 24) as i64);
    let found = IndexEntry { index, revision, cells, crc };
    if found != *wanted {
        return Err(damaged(format!("holds {found:?} where the index says {wanted:?}")));
    }
    let n = cells as usize;
    if n > MAX_CELLS {
        return Err(damaged(format!("{n} cells, at most {MAX_CELLS} fit")));
    }
    let raw = n * WORDS * 4;
    // Grows with what is really there: a small file that claims much costs little.
    let mut planes = Vec::new();
    let decoder = zstd::Decoder::new(&payload[TILE_HEAD..]).map_err(|e| damaged(e.to_string()))?;
    decoder.take(raw as u64 + 1).read_to_end(&mut planes).map_err(|e| damaged(e.to_string()))?;
    if planes.len() != raw {
        return Err(damaged(format!("its columns have {} bytes instead of {raw}", planes.len())));
    }
    let mut out = Vec::with_capacity(n);
    for i in 0..n {
        let word = |w: usize| u32::from_le_bytes([0, 1, 2, 3].map(|b| planes[(w * 4 + b) * n + i]));
        match cell(&std::array::from_fn(word)) {
            Some(c) => out.push(c),
            None => return Err(damaged(format!("cell {i} holds numbers no map has"))),
        }
    }
    let mut tile = Tile::with_cells(index, voxel_m, out);
    (tile.revision, tile.stamp_ns) = (revision, stamp_ns);
    Ok(tile)
}

/// The index file.
pub(super) fn encode_index(index: &MapIndex) -> Vec<u8> {
    let mut payload = Vec::new();
    let o = index.origin;
    [index.tile_m, index.voxel_m, o.x, o.y, o.z].iter().for_each(|x| payload.extend(x.to_le_bytes()));
    payload.extend(index.revision.to_le_bytes());
    payload.extend(index.first_stamp_ns.to_le_bytes());
    for e in &index.entries {
        e.index.iter().for_each(|x| payload.extend(x.to_le_bytes()));
        payload.extend(e.revision.to_le_bytes());
        payload.extend(e.cells.to_le_bytes());
        payload.extend(e.crc.to_le_bytes());
    }
    sealed(INDEX_MAGIC, &payload).0
}

/// Bytes of the index's payload before its lines, and of a line.
const INDEX_HEAD: usize = 5 * 8 + 16;
const INDEX_LINE: usize = 12 + 8 + 8;

/// Reads the index file.
pub(super) fn decode_index(path: &Path) -> Result<MapIndex, MapError> {
    let damaged = |reason: &str| MapError::Damaged { path: path.to_owned(), reason: reason.to_owned() };
    let (p, _) = opened(path, INDEX_MAGIC)?;
    if p.len() < INDEX_HEAD || !(p.len() - INDEX_HEAD).is_multiple_of(INDEX_LINE) {
        return Err(damaged("its length fits no number of tiles"));
    }
    let f = |at: usize| f64::from_bits(le_u64(&p, at));
    let origin = DVec3::new(f(16), f(24), f(32));
    let (tile_m, voxel_m) = (f(0), f(8));
    // Somewhat more than `map.tile_m` and `map.voxel_m` accept; in between everything is finite in f32.
    let sound = (0.1..=1e4).contains(&tile_m)
        && (1e-3..=1e3).contains(&voxel_m)
        && voxel_m >= tile_m / f64::from(MAX_PER_EDGE)
        && origin.is_finite();
    if !sound {
        return Err(damaged("its sizes or origin are no numbers a map has"));
    }
    let entries = p[INDEX_HEAD..]
        .chunks_exact(INDEX_LINE)
        .map(|e| IndexEntry {
            index: [0, 4, 8].map(|at| le_u32(e, at) as i32),
            revision: le_u64(e, 12),
            cells: le_u32(e, 20),
            crc: le_u32(e, 24),
        })
        .collect();
    Ok(MapIndex { tile_m, voxel_m, origin, revision: le_u64(&p, 40), first_stamp_ns: le_u64(&p, 48) as i64, entries })
}
