//! A cube of the map: its occupied voxels, with positions in f32 relative to its own corner.

use glam::Vec3;

use super::cell::{Cell, Sample, along};
use super::voxel::{LEVELS, MAX_CELLS, Slot, Table, key_at, level_of, parent};

/// Index of a tile along the map's axes, counted from the origin.
pub type TileIndex = [i32; 3];

/// A Gaussian longer along the ray than this part of its whole size lies along the ray: where it is along it says
/// nothing about another surface, so it only merges within its voxel. A ball has a third.
const ALONG_RAY: f32 = 0.4;

/// A surface seen from afar may lie this part of its voxel's edge beside where it is: about what its depth was off by.
const BORDER_PART: f32 = 0.25;

/// A Gaussian whose standard deviation along an axis is at most this part of the voxel's edge is a surface across it.
const THIN_PART: f32 = 0.2;

fn thin(cov: &[f32; 6], axis: usize, voxel_m: f32) -> bool {
    let most = THIN_PART * voxel_m;
    // Places of xx, yy and zz.
    [0, 3, 5].get(axis).is_some_and(|&k| cov[k] <= most * most)
}

/// Dead cells are taken out when they are more than one part in this many: finding the others again is then paid for.
const DEAD_PART: usize = 8;

/// What happened to one sample, or to all of a step.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct TileCounts {
    pub merged: u64,
    pub created: u64,
    /// Cells given up for finer ones.
    pub refined: u64,
    /// Cells that joined another of the same surface.
    pub joined: u64,
    /// Cells gone because rays passed through.
    pub carved: u64,
    /// Second opinions on what is not there.
    pub alone: u64,
    /// Samples a full tile could not take.
    pub no_room: u64,
}

/// A cube of the map.
#[derive(Debug, Clone)]
pub(super) struct Tile {
    pub index: TileIndex,
    /// Number of the window that changed it last.
    pub revision: u64,
    /// Stamp of that window, nanoseconds.
    pub stamp_ns: i64,
    pub cells: Vec<Cell>,
    table: Table,
    inverse_m: f32,
    dead: usize,
}

impl Tile {
    /// Without cells; `voxel_m` is the finest voxel's edge.
    pub fn new(index: TileIndex, voxel_m: f64) -> Self {
        let inverse_m = (1.0 / voxel_m) as f32;
        Self { index, revision: 0, stamp_ns: 0, cells: Vec::new(), table: Table::default(), inverse_m, dead: 0 }
    }

    /// With cells whose keys are all different.
    pub fn with_cells(index: TileIndex, voxel_m: f64, cells: Vec<Cell>) -> Self {
        let mut tile = Self::new(index, voxel_m);
        tile.cells = cells;
        tile.rebuild();
        tile
    }

    pub fn bytes(&self) -> usize {
        self.cells.capacity() * size_of::<Cell>() + self.table.bytes() + size_of::<Self>()
    }

    fn voxel_m(&self, level: u32) -> f32 {
        (1u32 << level) as f32 / self.inverse_m
    }

    /// The cell around a place, of whatever size; `position` relative to the corner.
    pub fn around(&self, position: Vec3) -> Option<&Cell> {
        let mut level = LEVELS - 1;
        loop {
            match self.table.get(key_at(position, self.inverse_m, level)) {
                Slot::Cell(i) => return self.cells.get(i as usize).filter(|c| c.support > 0.0),
                _ if level == 0 => return None,
                _ => level -= 1,
            }
        }
    }

    /// Merges a sample into the surface it belongs to, or starts a new cell.
    pub fn add(&mut self, s: &Sample, now_ms: u32, counts: &mut TileCounts) {
        let (key, here) = self.place_of(s);
        let level = level_of(key);
        let alive = here.filter(|&i| self.cells[i as usize].support > 0.0);
        if let Some(i) = alive.or_else(|| self.along_ray(s, level, None)) {
            self.cells[i as usize].merge(s, now_ms);
            counts.merged += 1;
            if s.fresh && alive.is_some() {
                counts.joined += self.join_layers(i, s, level);
            }
        } else if !s.fresh {
            counts.alone += 1;
        } else if let Some(i) = here {
            self.cells[i as usize] = Cell::new(key, s, now_ms);
            self.dead -= 1;
            counts.created += 1;
        } else if self.known_finer(s, level) {
            counts.alone += 1;
        } else if self.cells.len() < MAX_CELLS {
            counts.refined += self.refine_around(key) + self.refine_beside(s, level);
            self.table.put_cell(key, self.cells.len() as u32);
            self.cells.push(Cell::new(key, s, now_ms));
            counts.created += 1;
        } else {
            counts.no_room += 1;
        }
    }

    /// A surface near a voxel's border is seen now on this side, now on that: two cells one behind the other within the
    /// gate are one surface, and the weaker joins the stronger.
    fn join_layers(&mut self, i: u32, s: &Sample, level: u32) -> u64 {
        let Some(other) = self.along_ray(s, level, Some(i)) else { return 0 };
        let (a, b) = (self.cells[i as usize], self.cells[other as usize]);
        let (stays, goes) = if a.weight >= b.weight { (i, other) } else { (other, i) };
        let gone = self.cells[goes as usize];
        self.cells[stays as usize].absorb(&gone);
        self.cells[goes as usize].support = 0.0;
        self.dead += 1;
        1
    }

    /// Whether the surface is known better on the other side of its voxel's border: the sample is thin across a face,
    /// near it, and the voxel beyond holds finer cells.
    fn known_finer(&self, s: &Sample, level: u32) -> bool {
        let reach = BORDER_PART * self.voxel_m(level);
        let beyond = |axis: usize, sign: f32| {
            let at = s.position + Vec3::AXES[axis] * (sign * reach);
            self.table.get(key_at(at, self.inverse_m, level)) == Slot::Refined
        };
        level > 0 && (0..3).any(|k| thin(&s.cov, k, self.voxel_m(level)) && (beyond(k, 1.0) || beyond(k, -1.0)))
    }

    /// Coarser cells of the same surface on the other side of their voxel's border: they go, as those around the new
    /// cell do.
    fn refine_beside(&mut self, s: &Sample, level: u32) -> u64 {
        let mut gone = 0;
        for coarser in level + 1..LEVELS {
            let voxel_m = self.voxel_m(coarser);
            let reach = BORDER_PART * voxel_m;
            for k in 0..6 {
                let (axis, signed) = (k / 2, if k % 2 == 0 { reach } else { -reach });
                let at = s.position + Vec3::AXES[axis] * signed;
                let Slot::Cell(i) = self.table.get(key_at(at, self.inverse_m, coarser)) else { continue };
                let cell = &mut self.cells[i as usize];
                let apart = (cell.position - s.position)[axis];
                if cell.support > 0.0 && thin(&cell.cov, axis, voxel_m) && apart.abs() <= reach {
                    cell.support = 0.0;
                    self.dead += 1;
                    gone += 1;
                }
            }
        }
        gone
    }

    /// Files a cell of another tile here, in its own voxel size; `cell.position` is relative to this tile's corner.
    pub fn adopt(&mut self, mut cell: Cell) {
        let mut level = level_of(cell.key);
        loop {
            cell.key = key_at(cell.position, self.inverse_m, level);
            match self.table.get(cell.key) {
                Slot::Cell(i) => {
                    let here = &mut self.cells[i as usize];
                    if here.support > 0.0 {
                        here.absorb(&cell);
                    } else {
                        *here = cell;
                        self.dead -= 1;
                    }
                    return;
                }
                Slot::Refined if level > 0 => level -= 1,
                _ => break,
            }
        }
        if self.cells.len() < MAX_CELLS {
            self.refine_around(cell.key);
            self.table.put_cell(cell.key, self.cells.len() as u32);
            self.cells.push(cell);
        }
    }

    /// The voxel a sample goes to: of its own size, or smaller where the place is known better. And its cell.
    fn place_of(&self, s: &Sample) -> (u32, Option<u32>) {
        let mut level = s.level.min(LEVELS - 1);
        loop {
            let key = key_at(s.position, self.inverse_m, level);
            match self.table.get(key) {
                Slot::Cell(i) => return (key, Some(i)),
                Slot::Refined if level > 0 => level -= 1,
                _ => return (key, None),
            }
        }
    }

    /// A cell before or behind on the ray, near enough to be the same surface seen with an error in depth.
    fn along_ray(&self, s: &Sample, level: u32, except: Option<u32>) -> Option<u32> {
        let size = s.cov[0] + s.cov[3] + s.cov[5];
        let across = along(&s.cov, s.ray) <= ALONG_RAY * size;
        if !(s.gate_m > 0.0 && across) {
            return None;
        }
        let step = self.voxel_m(level);
        let mut offset = step.min(s.gate_m);
        loop {
            for signed in [offset, -offset] {
                if let Slot::Cell(i) = self.table.get(key_at(s.position + s.ray * signed, self.inverse_m, level)) {
                    let cell = &self.cells[i as usize];
                    let apart = (cell.position - s.position).dot(s.ray);
                    if cell.support > 0.0 && apart.abs() <= s.gate_m && except != Some(i) {
                        return Some(i);
                    }
                }
            }
            if offset + step <= s.gate_m {
                offset += step;
            } else {
                return None;
            }
        }
    }

    /// Marks the larger voxels around `key`; a cell at one of them has now been seen better and goes.
    fn refine_around(&mut self, key: u32) -> u64 {
        let (mut gone, mut up) = (0, parent(key));
        while let Some(larger) = up {
            match self.table.get(larger) {
                Slot::Refined => break,
                Slot::Cell(i) => {
                    let cell = &mut self.cells[i as usize];
                    if cell.support > 0.0 {
                        cell.support = 0.0;
                        self.dead += 1;
                        gone += 1;
                    }
                    self.table.put_refined(larger);
                }
                Slot::Empty => self.table.put_refined(larger),
            }
            up = parent(larger);
        }
        gone
    }

    /// Asks every cell whether it is contradicted; those that lose all support are dead.
    pub fn contradict(&mut self, counts: &mut TileCounts, mut passed_through: impl FnMut(&Cell) -> bool) {
        for i in 0..self.cells.len() {
            let cell = &self.cells[i];
            if cell.support > 0.0 && passed_through(cell) && self.cells[i].contradict() {
                self.dead += 1;
                counts.carved += 1;
            }
        }
    }

    /// Gives up cells by number.
    pub fn give_up(&mut self, cells: impl IntoIterator<Item = usize>) {
        for i in cells {
            if let Some(cell) = self.cells.get_mut(i).filter(|c| c.support > 0.0) {
                cell.support = 0.0;
                self.dead += 1;
            }
        }
    }

    /// Cells that are not dead.
    pub fn len(&self) -> usize {
        self.cells.len() - self.dead
    }

    /// Those cells.
    pub fn live(&self) -> impl Iterator<Item = &Cell> {
        self.cells.iter().filter(|c| c.support > 0.0)
    }

    /// Takes the dead cells out once there are enough of them to pay for it.
    pub fn tidy(&mut self) {
        if DEAD_PART * self.dead > self.cells.len() {
            self.sweep();
        }
    }

    /// Takes the dead cells out.
    pub fn sweep(&mut self) {
        if self.dead > 0 {
            self.cells.retain(|c| c.support > 0.0);
            // Mostly empty is worth a smaller allocation.
            if self.cells.len() < self.cells.capacity() / 4 {
                self.cells.shrink_to(2 * self.cells.len());
            }
            self.rebuild();
        }
    }

    fn rebuild(&mut self) {
        self.table.clear();
        self.dead = 0;
        for i in 0..self.cells.len() {
            let key = self.cells[i].key;
            self.table.put_cell(key, i as u32);
            let mut up = parent(key);
            while let Some(larger) = up {
                if self.table.get(larger) == Slot::Refined {
                    break;
                }
                self.table.put_refined(larger);
                up = parent(larger);
            }
        }
    }

    /// True when cells and table agree; for tests.
    pub fn is_consistent(&self) -> bool {
        self.live().count() == self.len()
            && self.cells.iter().enumerate().filter(|(_, c)| c.support > 0.0).all(|(i, c)| {
                let mut marked = std::iter::successors(parent(c.key), |&k| parent(k));
                self.table.get(c.key) == Slot::Cell(i as u32) && marked.all(|k| self.table.get(k) == Slot::Refined)
            })
    }
}
