//! The pictures a map is fitted to, and what in them moves.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Result, bail};
use glam::DVec3;
use storm_render::{Intrinsics, View};

use crate::config::Config;
use crate::engine::evaluate::bag::run_front;
use crate::engine::truth::unit;
use crate::output::objects_csv::read_objects;
use crate::pipeline::front::FrontOutput;
use crate::rigid::Rigid;
use crate::source::bag::BagSource;

/// Boxes are this much larger on every side than what was seen of the object, metres.
const ROOM_M: f64 = 0.3;
/// A box nearer than this to the camera's plane counts as everywhere in the picture, metres.
const NEAR_M: f32 = 0.3;
/// A row of `objects.csv` applies to pictures this far from its stamp at most, nanoseconds.
const SAME_NS: u64 = 60_000_000;

/// One picture.
pub struct Shot {
    /// From where, in the map's local frame.
    pub view: View,
    /// `height * width * 3` colours of 0-1.
    pub rgb01: Vec<f32>,
    /// Pixels that may show something that moves, or show nothing.
    pub moves: Vec<bool>,
    /// Never fitted to.
    pub held_out: bool,
}

/// Where moving objects were: boxes by stamp.
#[derive(Debug, Default)]
pub struct Boxes(BTreeMap<i64, Vec<(Rigid, DVec3)>>);

impl Boxes {
    /// Reads `objects.csv`.
    ///
    /// # Errors
    /// A file that cannot be read, or a row that is not one of that file.
    pub fn read(path: &Path) -> Result<Self> {
        let mut boxes = Self::default();
        for row in read_objects(path)? {
            boxes.0.entry(row.stamp_ns).or_default().push((row.map_from_box, 0.5 * row.size_m));
        }
        Ok(boxes)
    }

    /// Boxes at about a stamp.
    fn at(&self, stamp_ns: i64) -> impl Iterator<Item = &(Rigid, DVec3)> {
        let after = self.0.range(stamp_ns..).next();
        let before = self.0.range(..stamp_ns).next_back();
        let nearest = after.into_iter().chain(before).min_by_key(|(s, _)| s.abs_diff(stamp_ns));
        nearest.filter(|(s, _)| s.abs_diff(stamp_ns) <= SAME_NS).into_iter().flat_map(|(_, boxes)| boxes)
    }
}

/// Pixels inside the rectangles around boxes.
fn covered(view: &View, local_from_map: &Rigid, boxes: impl Iterator<Item = (Rigid, DVec3)>) -> Vec<bool> {
    let k: Intrinsics = view.intrinsics;
    let mut out = vec![false; k.width * k.height];
    for (map_from_box, half) in boxes {
        let (mut low, mut high) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
        let (mut behind, mut ahead) = (0, 0);
        for corner in 0..8 {
            let sign = |bit: usize| if corner >> bit & 1 == 1 { 1.0 } else { -1.0 };
            let p = DVec3::new(sign(0), sign(1), sign(2)) * (half + ROOM_M);
            let p = view.camera_from_world.transform_point3(local_from_map.apply(map_from_box.apply(p)).as_vec3());
            if p.z < NEAR_M {
                behind += 1;
                continue;
            }
            ahead += 1;
            let uv = [k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy];
            for a in 0..2 {
                (low[a], high[a]) = (low[a].min(uv[a]), high[a].max(uv[a]));
            }
        }
        if ahead == 0 {
            continue;
        }
        if behind > 0 {
            (low, high) = ([0.0; 2], [k.width as f32, k.height as f32]);
        }
        // `as` saturates at 0.
        let span = |a: usize, most: usize| (low[a].floor() as usize).min(most)..(high[a].ceil() as usize).min(most);
        for r in span(1, k.height) {
            span(0, k.width).for_each(|c| out[r * k.width + c] = true);
        }
    }
    out
}

/// Pictures of a bag at `size`, at most `most` moments spread evenly, every `hold_out`th of them held out.
///
/// # Errors
/// A bag that cannot be read or that holds no synchronized sets with poses.
pub fn shots(
    bag: &Path,
    config: &Config,
    size: (usize, usize),
    map_from_local: &Rigid,
    boxes: &Boxes,
    (most, hold_out): (usize, usize),
) -> Result<Vec<Shot>> {
    let source = BagSource::open(bag, config, size)?;
    source.rig().log(size);
    let cameras = source.rig().intrinsics();
    let mut total = 0usize;
    run_front(&source, config, |output| {
        total += usize::from(matches!(output, FrontOutput::Set(_)));
        Ok(true)
    })?;
    if total == 0 {
        bail!("{} holds no synchronized sets with poses", bag.display());
    }
    let every = total.div_ceil(most.max(1));
    let local_from_map = map_from_local.inverse();
    let (mut n, mut out) = (0usize, Vec::new());
    run_front(&source, config, |output| {
        let FrontOutput::Set(set) = output else { return Ok(true) };
        let taken = n.is_multiple_of(every);
        let moment = n / every;
        n += 1;
        if taken {
            for (frame, k) in set.frames.iter().zip(&cameras) {
                let local_from_camera = crate::window::relative(map_from_local, &frame.map_from_camera);
                let view = View::from_pose(local_from_camera.to_f32(), *k);
                let mut moves = covered(&view, &local_from_map, boxes.at(set.stamp_ns).copied());
                moves.iter_mut().enumerate().for_each(|(i, moves)| *moves |= !frame.item.is_valid(i));
                let held_out = hold_out > 0 && moment % hold_out == hold_out - 1;
                out.push(Shot { view, rgb01: unit(&frame.item.rgb.data), moves, held_out });
            }
        }
        Ok(true)
    })?;
    Ok(out)
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    #[test]
    fn boxes_cover_what_they_project_to() {
        let text = format!(
            "{}\n3,1000,10.0,0.0,0.0,0.0,2.0,2.0,2.0,1,0,0,1,1,1,9\n",
            crate::output::objects_csv::OBJECTS_HEADER
        );
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("objects.csv");
        std::fs::write(&path, &text).unwrap();
        let boxes = Boxes::read(&path).unwrap();
        assert_eq!(boxes.at(1_000_000).count(), 1);
        assert_eq!(boxes.at(900_000_000).count(), 0);
        let k = Intrinsics::from_fov(60.0, 60, 40);
        let pose = crate::window::camera_from_flu().inverse();
        let view = View::from_pose(pose.to_f32(), k);
        let pixels = covered(&view, &Rigid::IDENTITY, boxes.at(1000).copied());
        assert!(pixels[20 * 60 + 30] && !pixels[0] && !pixels[20 * 60 + 5], "ahead, and not beside");
        // Behind the camera it is nowhere, around the camera everywhere.
        let at = |x: f64| [(Rigid::new(DQuat::IDENTITY, DVec3::X * x), DVec3::ONE)].into_iter();
        assert!(covered(&view, &Rigid::IDENTITY, at(-10.0)).iter().all(|c| !c));
        assert!(covered(&view, &Rigid::IDENTITY, at(0.5)).iter().all(|c| *c));
    }
}
