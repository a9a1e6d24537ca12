//! What a part's surface is made of. The texture functions live in `texture` and `facade`.

use glam::Vec3;

/// Kind of surface; lengths in metres in the part's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Surface {
    /// One colour with fine grain.
    Plain,
    /// One colour that shines a little (metal, plastic).
    Sheen,
    /// The head of a street lamp: shines a little by day, burns at night.
    Lamp,
    /// Blotchy colour (cloth, bark).
    Rough,
    /// Leaves: clumps of light and dark.
    Leaves,
    /// Horizontal boards or courses of `step` metres.
    Courses { step: f32 },
    /// Vertical boards of `step` metres.
    Boards { step: f32 },
    /// House front.
    Facade(Facade),
    /// Car body with lights, grille and doors; wheel arches at these x, with this radius.
    Body { axles: [f32; 2], arch: f32 },
    /// Glass on all sides between pillars, painted roof.
    Cabin,
    /// Box of a van, bus or lorry; windows from `glass` (share of the height) up on the sides, none if 1.
    Coach { glass: f32, stripe: f32 },
    /// Tyre and rim.
    Wheel,
    /// Traffic sign: a rim of `accent` around `color`, a dark symbol inside.
    Sign { round: bool },
    /// Traffic light's box: one lamp burns.
    Signal { lamp: u8 },
    /// Poster: big blocks of colour.
    Poster,
}

/// How a house front is divided.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Facade {
    /// Width of one window's cell and height of one floor, metres.
    pub cell: f32,
    pub floor: f32,
    /// Share of the cell that the window covers, across and up.
    pub open: [f32; 2],
    /// Shop windows on the ground floor.
    pub shop: bool,
    /// Courses of brick.
    pub brick: bool,
}

/// A part's material.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Material {
    pub surface: Surface,
    pub color: Vec3,
    pub accent: Vec3,
    pub seed: u32,
}

impl Material {
    pub(crate) fn new(surface: Surface, color: Vec3) -> Self {
        Self { surface, color, accent: color, seed: 0 }
    }

    pub(crate) fn accent(mut self, accent: Vec3) -> Self {
        self.accent = accent;
        self
    }

    pub(crate) fn seed(mut self, seed: u64) -> Self {
        self.seed = seed as u32;
        self
    }
}

/// Linear colour from 8-bit sRGB-like numbers.
pub(crate) fn rgb(r: u8, g: u8, b: u8) -> Vec3 {
    Vec3::new(f32::from(r), f32::from(g), f32::from(b)).map(|x| (x / 255.0).powf(2.2))
}
