//! What of a step is worked out.

/// What somebody wants of a step; nothing else is worked out. The map and the Gaussians always are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Demand {
    /// Motion groups in the pictures (the motion masks).
    pub motion: bool,
    /// Point trajectories.
    pub tracks: bool,
    /// Moving objects.
    pub objects: bool,
    /// The static map, and with it the pictures (the map is judged by them).
    pub map: bool,
    /// The pictures, although there is no map.
    pub pictures: bool,
}

impl Demand {
    /// Everything.
    pub const ALL: Self = Self { motion: true, tracks: true, objects: true, map: true, pictures: true };

    /// Whether the newest cameras' views are drawn for it.
    pub fn drawn(&self) -> bool {
        self.pictures || self.map
    }

    /// Whether what was worked out for this is enough for `other`; trajectories and objects are followed anew either way.
    pub fn covers(&self, other: Self) -> bool {
        (self.motion || !other.motion) && (self.drawn() || !other.pictures) && (self.map || !other.map)
    }
}
