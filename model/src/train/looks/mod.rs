//! How the images of training clips are made to differ from each other, so that weights do not depend on the procedural drive's
//! own look. Geometry and its truth are never touched; clips for validation keep the drive's own look.

mod camera;
mod jpeg;
mod motion;
mod poses;
pub(super) mod rig;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};
use storm_render::world::DriveLooks;

pub(super) use camera::RigLook;
pub(super) use motion::Shutter;
pub(super) use poses::PoseErrors;

/// What varies from clip to clip. The default is plain: nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LookOptions {
    /// The cameras: grey or colour, white balance, exposure and its drift, vignetting, tone curve, blur by focus and by motion,
    /// noise, JPEG.
    pub sensor: bool,
    /// The drive's light: skies, low sun, night with lamps, wet roads.
    pub light: bool,
    /// The drive's textures: roughness of every scale, colours, patterns, foliage with holes.
    pub textures: bool,
    /// Solids that fly through a fifth of the drives.
    pub solids: bool,
    /// Parked vehicles that pull out into the lane.
    pub pull_out: bool,
    /// Layouts, tilts and lenses of real vehicles' cameras.
    pub rigs: bool,
    /// Small errors of the poses that the network is given.
    pub poses: bool,
}

/// The names of the parts with where they are kept.
type Part = (&'static str, fn(&mut LookOptions) -> &mut bool);

const PARTS: [Part; 7] = [
    ("sensor", |x| &mut x.sensor),
    ("light", |x| &mut x.light),
    ("textures", |x| &mut x.textures),
    ("solids", |x| &mut x.solids),
    ("pull_out", |x| &mut x.pull_out),
    ("rigs", |x| &mut x.rigs),
    ("poses", |x| &mut x.poses),
];

impl LookOptions {
    /// Everything varies.
    pub fn varied() -> Self {
        let mut looks = Self::default();
        PARTS.iter().for_each(|(_, part)| *part(&mut looks) = true);
        looks
    }

    /// From `plain`, `varied`, or names of parts with commas between them.
    ///
    /// # Errors
    /// A name that is no part, with those that are.
    pub fn parse(text: &str) -> Result<Self, String> {
        match text {
            "plain" => return Ok(Self::default()),
            "varied" => return Ok(Self::varied()),
            _ => {}
        }
        let mut looks = Self::default();
        for name in text.split(',') {
            let Some((_, part)) = PARTS.iter().find(|(known, _)| *known == name) else {
                let known = PARTS.map(|(name, _)| name).join(", ");
                return Err(format!("`{name}` is no part of the looks; use plain, varied, or some of {known}"));
            };
            *part(&mut looks) = true;
        }
        Ok(looks)
    }

    /// What of it is the drive's business.
    pub fn drive(&self) -> DriveLooks {
        let Self { light, textures, solids, pull_out, rigs, .. } = *self;
        DriveLooks { light, textures, solids, pull_out, rigs }
    }

    /// The names of what varies, as [`LookOptions::parse`] takes them.
    pub fn describe(mut self) -> String {
        let names: Vec<_> = PARTS.iter().filter(|(_, part)| *part(&mut self)).map(|(name, _)| *name).collect();
        match names.len() {
            0 => "plain".to_owned(),
            n if n == PARTS.len() => "varied".to_owned(),
            _ => names.join(","),
        }
    }
}
