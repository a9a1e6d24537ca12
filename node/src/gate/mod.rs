//! Which steps need not be computed: a window that shows what the last computed one showed has the same result.
//!
//! A vehicle that waits at a light sees the same four timesteps again and again. The new window is compared with the one last
//! computed, timestep by timestep and camera by camera: same place, same picture up to noise, so same input, so same result.
//! Where something moves, the last result may still explain the new pictures once it is moved on ([`predict`]). What is skipped
//! in either way is checked against full steps by the [`contract`], and the ladder of notches ([`skipper`]) goes down where it
//! is broken.
//!
//! Comparing with the last *computed* window and not with the last frame means that slow changes add up until they are seen;
//! comparing all timesteps means that a car that has just stopped goes on being computed until no timestep shows it moving.

pub mod change;
pub mod contract;
pub mod predict;
pub mod skipper;

use crate::config::SkipConfig;
use crate::source::Frame;
use crate::window::{PosedSet, Window, relative};

use change::{Change, Sensitivity, first_change};

/// Why a window has to be computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Different {
    /// Another epoch, other cameras or another number of timesteps.
    Shape,
    /// A camera is elsewhere, relative to the anchor or in the map.
    Pose {
        /// Timestep.
        step: usize,
        /// Camera.
        camera: usize,
    },
    /// The timesteps are not as far apart.
    Time,
    /// A picture shows something else.
    Picture {
        /// Timestep.
        step: usize,
        /// Camera.
        camera: usize,
        /// Where, and by how much.
        change: Change,
    },
}

/// Whether `new` shows what `computed` showed; else the first difference found.
pub fn same(config: &SkipConfig, computed: &Window<Frame>, new: &Window<Frame>) -> Result<(), Different> {
    let cameras = |set: &PosedSet<Frame>| set.frames.len();
    let fits = computed.epoch == new.epoch
        && computed.steps.len() == new.steps.len()
        && computed.steps.iter().zip(&new.steps).all(|(a, b)| cameras(a) == cameras(b));
    if !fits {
        return Err(Different::Shape);
    }
    let times = |w: &Window<Frame>| w.time_sec.iter().flatten().copied().collect::<Vec<f64>>();
    if !times(computed).iter().zip(times(new)).all(|(a, b)| (a - b).abs() <= config.still_sec) {
        return Err(Different::Time);
    }
    let moved = |step: usize, camera: usize| {
        let (a, b) = (&computed.steps[step].frames[camera], &new.steps[step].frames[camera]);
        let gap = relative(&a.map_from_camera, &b.map_from_camera);
        let still = gap.translation.length() <= config.still_m
            && gap.rotation.angle_to_identity() <= config.still_deg.to_radians();
        !still
    };
    let places =
        || (0..new.steps.len()).flat_map(|step| (0..cameras(&new.steps[step])).map(move |camera| (step, camera)));
    if let Some((step, camera)) = places().find(|&(step, camera)| moved(step, camera)) {
        return Err(Different::Pose { step, camera });
    }
    let sensitivity = Sensitivity { sigmas: config.still_sigmas as f32, levels: config.still_levels as f32 };
    // Newest first: that is where something new shows.
    for step in (0..new.steps.len()).rev() {
        for camera in 0..cameras(&new.steps[step]) {
            let (a, b) = (&computed.steps[step].frames[camera].item, &new.steps[step].frames[camera].item);
            if std::sync::Arc::ptr_eq(&a.rgb, &b.rgb) {
                continue;
            }
            if let Some(change) = first_change(&a.rgb, &b.rgb, b.valid.as_deref(), sensitivity) {
                return Err(Different::Picture { step, camera, change });
            }
        }
    }
    Ok(())
}

trait Angle {
    fn angle_to_identity(&self) -> f64;
}

/// Mean of differences that are 0 where `valid` is false, over the others; 0 of none.
fn pictures_mean(d: &[i16], valid: Option<&[bool]>) -> f32 {
    d.iter().map(|&x| i64::from(x)).sum::<i64>() as f32 / shown(d.len(), valid)
}

/// How many of `n` pixels show something, at least 1.
fn shown(n: usize, valid: Option<&[bool]>) -> f32 {
    valid.map_or(n, |valid| valid.iter().filter(|valid| **valid).count()).max(1) as f32
}

impl Angle for glam::DQuat {
    /// 0 to pi.
    fn angle_to_identity(&self) -> f64 {
        2.0 * self.xyz().length().atan2(self.w.abs())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::{DQuat, DVec3};

    use super::*;
    use crate::decode::RgbPicture;
    use crate::dice::Dice;
    use crate::rigid::Rigid;
    use crate::window::{PosedFrame, WindowBuilder};

    const HOP_NS: i64 = 100_000_000;

    /// A camera that sees a fixed street with noise; `paint` puts movers in, `pose` moves it.
    fn set(k: i64, paint: &dyn Fn(i64, &mut RgbPicture), pose: &dyn Fn(i64) -> Rigid) -> PosedSet<Frame> {
        let frames = (0..2).map(|camera| {
            let (width, height) = (48, 32);
            let mut dice = Dice::new(7919 * k as u64 + camera);
            let value = |i: usize, dice: &mut Dice| {
                let base = 100.0 + 50.0 * ((i as f32) * 0.05).sin();
                (base + 2.0 * (dice.unit() + dice.unit() + dice.unit() - 1.5)).round() as u8
            };
            let data = (0..3 * width * height).map(|i| value(i, &mut dice)).collect();
            let mut rgb = RgbPicture { width, height, data };
            paint(k, &mut rgb);
            PosedFrame { stamp_ns: k * HOP_NS, map_from_camera: pose(k), item: Frame::whole(rgb) }
        });
        PosedSet { stamp_ns: k * HOP_NS, epoch: 0, frames: frames.collect() }
    }

    /// Windows of 4 timesteps half a second apart, at 10 Hz; not the first ones, whose oldest timestep may lie nearer.
    fn windows(n: i64, paint: &dyn Fn(i64, &mut RgbPicture), pose: &dyn Fn(i64) -> Rigid) -> Vec<Window<Frame>> {
        let mut builder = WindowBuilder::new(&crate::config::WindowConfig::default(), 0);
        (0..n).filter_map(|k| builder.push(set(k, paint, pose))).skip(4).collect()
    }

    fn still(_: i64) -> Rigid {
        Rigid::new(DQuat::IDENTITY, DVec3::new(1e5, 2e5, 0.0))
    }

    fn nothing(_: i64, _: &mut RgbPicture) {}

    fn block(p: &mut RgbPicture, x0: usize, side: usize, levels: i16) {
        for y in 10..10 + side {
            for x in x0..x0 + side {
                for c in 0..3 {
                    let v = &mut p.data[3 * (y * p.width + x) + c];
                    *v = (i16::from(*v) + levels).clamp(0, 255) as u8;
                }
            }
        }
    }

    #[test]
    fn a_standing_vehicle_in_a_standing_scene_sees_the_same() {
        let windows = windows(40, &nothing, &still);
        assert!(windows.len() > 15);
        for w in &windows {
            assert_eq!(same(&SkipConfig::default(), &windows[0], w), Ok(()));
        }
    }

    #[test]
    fn a_pedestrian_who_steps_out_is_seen_in_his_first_picture() {
        // Steps out at set 25, two pixels wide, and walks a pixel a set.
        let paint = |k: i64, p: &mut RgbPicture| {
            if k >= 25 {
                block(p, (k - 25) as usize % 40, 2, 50);
            }
        };
        let windows = windows(40, &paint, &still);
        let first = windows.iter().position(|w| w.stamp_ns == 25 * HOP_NS).unwrap();
        for w in &windows[..first] {
            assert_eq!(same(&SkipConfig::default(), &windows[0], w), Ok(()));
        }
        for w in &windows[first..] {
            assert!(matches!(same(&SkipConfig::default(), &windows[0], w), Err(Different::Picture { .. })));
        }
    }

    #[test]
    fn a_car_that_has_stopped_is_computed_until_no_timestep_shows_it_moving() {
        let stops = 20;
        let paint = |k: i64, p: &mut RgbPicture| block(p, k.min(stops) as usize, 6, 60);
        let windows = windows(60, &paint, &still);
        let config = SkipConfig::default();
        let mut computed = &windows[0];
        for w in &windows[1..] {
            let skipped = same(&config, computed, w).is_ok();
            // The oldest timestep lies 1.5 s back, and the window computed before has to have shown the same.
            assert!(!skipped || w.stamp_ns > (stops + 15) * HOP_NS, "skipped at {} ns", w.stamp_ns);
            if !skipped {
                computed = w;
            }
        }
        assert_eq!(same(&config, computed, windows.last().unwrap()), Ok(()), "in the end all stands");
        // And one that starts again.
        let starts = |k: i64, p: &mut RgbPicture| block(p, 10 + (k - 40).max(0) as usize % 20, 6, 60);
        let windows = self::windows(50, &starts, &still);
        let at = windows.iter().position(|w| w.stamp_ns == 41 * HOP_NS).unwrap();
        assert!(same(&config, &windows[0], &windows[at - 2]).is_ok());
        assert!(same(&config, &windows[0], &windows[at]).is_err());
    }

    #[test]
    fn what_masked_pixels_show_is_no_difference() {
        // A wiper sweeps over the upper rows.
        let wiper = |k: i64, p: &mut RgbPicture| block(p, k as usize % 40, 6, 90);
        let masked = |mut windows: Vec<Window<Frame>>| {
            let valid: Arc<[bool]> = (0..48 * 32).map(|i| i / 48 >= 18).collect();
            for set in windows.iter_mut().flat_map(|w| &mut w.steps) {
                let mut copy = (**set).clone();
                copy.frames.iter_mut().for_each(|frame| frame.item.valid = Some(valid.clone()));
                *set = Arc::new(copy);
            }
            windows
        };
        let windows = windows(40, &wiper, &still);
        assert!(same(&SkipConfig::default(), &windows[0], &windows[5]).is_err());
        let windows = masked(windows);
        for w in &windows {
            assert_eq!(same(&SkipConfig::default(), &windows[0], w), Ok(()));
        }
    }

    #[test]
    fn exposure_ego_motion_and_drift_are_differences() {
        let brighter = |k: i64, p: &mut RgbPicture| {
            if k >= 30 {
                p.data.iter_mut().for_each(|x| *x = x.saturating_add(6));
            }
        };
        let windows = windows(40, &brighter, &still);
        assert!(same(&SkipConfig::default(), &windows[0], windows.last().unwrap()).is_err());
        // 2 mm a set: each is within the limit, their sum is not.
        let creeping = |k: i64| Rigid::new(DQuat::IDENTITY, DVec3::new(0.002 * k as f64, 0.0, 0.0));
        let windows = self::windows(60, &nothing, &creeping);
        assert_eq!(same(&SkipConfig::default(), &windows[0], &windows[1]), Ok(()));
        assert!(matches!(
            same(&SkipConfig::default(), &windows[0], windows.last().unwrap()),
            Err(Different::Pose { .. })
        ));
        let turning = |k: i64| Rigid::new(DQuat::from_rotation_z(1e-3 * k as f64), DVec3::ZERO);
        let windows = self::windows(60, &nothing, &turning);
        assert!(matches!(
            same(&SkipConfig::default(), &windows[0], windows.last().unwrap()),
            Err(Different::Pose { .. })
        ));
    }

    #[test]
    fn other_epochs_and_poses_that_are_no_numbers_are_differences() {
        let windows = windows(30, &nothing, &still);
        let mut other = windows[1].clone();
        other.epoch = 1;
        assert_eq!(same(&SkipConfig::default(), &windows[0], &other), Err(Different::Shape));
        let broken = |_: i64| Rigid::new(DQuat::IDENTITY, DVec3::new(f64::NAN, 0.0, 0.0));
        let mut odd = windows[1].clone();
        odd.steps[3] = Arc::new(set(50, &nothing, &broken));
        assert!(matches!(same(&SkipConfig::default(), &windows[0], &odd), Err(Different::Pose { step: 3, .. })));
    }
}
