//! What of a drive's look varies beyond the usual.

/// Parts of the look of a drive that may vary; how they do follows from the drive's seed. The default is the usual look: nothing
/// varies, and the images are the same bytes as ever.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DriveLooks {
    /// Light: white and stormy skies, low sun, hard shadows, dusk and night with lamps, wet roads.
    pub light: bool,
    /// Textures: roughness of every scale, other colours, bold patterns, foliage with holes.
    pub textures: bool,
    /// Textured solids that fly through the scene at 3 to 20 m/s, in a fifth of the drives.
    pub solids: bool,
    /// Parked vehicles that pull out into the lane.
    pub pull_out: bool,
    /// Layouts, heights and tilts of real vehicles' cameras.
    pub rigs: bool,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::{Drive, DriveOptions, WorldFrame};
    use glam::{DVec3, Vec3};

    const ALL: DriveLooks = DriveLooks { light: true, textures: true, solids: true, pull_out: true, rigs: true };

    fn options(seed: u64, looks: DriveLooks) -> DriveOptions {
        DriveOptions { seed, seconds: 3.0, width: 96, height: 64, looks, ..Default::default() }
    }

    fn drive(seed: u64, looks: DriveLooks) -> Drive {
        Drive::new(&options(seed, looks)).unwrap()
    }

    fn map_point(drive: &Drive, camera: usize, time: f64, frame: &WorldFrame, i: usize) -> DVec3 {
        let c = &drive.cameras()[camera];
        let (u, v) = ((i % frame.width) as f32 + 0.5, (i / frame.width) as f32 + 0.5);
        let p = c.intrinsics.ray(u, v) * frame.depth[i];
        (drive.map_from_base(time) * c.base_from_camera).transform_point3(p.as_dvec3())
    }

    #[test]
    fn colours_vary_and_geometry_does_not_by_light_alone() {
        let mut changed = 0;
        for seed in 0..16 {
            let light = DriveLooks { light: true, ..Default::default() };
            let (a, b) = (drive(seed, DriveLooks::default()).render(1, 0.7), drive(seed, light).render(1, 0.7));
            assert_eq!(WorldFrame { rgb: a.rgb.clone(), ..b.clone() }, a, "seed {seed}");
            changed += usize::from(a.rgb != b.rgb);
        }
        assert!(changed > 12, "{changed} of 16");
    }

    #[test]
    fn varied_images_are_sound_and_follow_from_the_seed() {
        let mut dark = 0;
        for seed in 0..40 {
            let (a, b) = (drive(seed, ALL), drive(seed, ALL));
            for camera in [2, 0, 1] {
                let f = a.render(camera, 1.3);
                assert_eq!(f, b.render(camera, 1.3));
                assert!(f.depth.iter().all(|d| d.is_finite() && *d >= 0.0));
                assert!(f.depth.iter().zip(&f.sky).all(|(d, s)| (*d == 0.0) == (*s == 1)));
                let mean = f.rgb.iter().map(|&x| u64::from(x)).sum::<u64>() / f.rgb.len() as u64;
                dark += usize::from(mean < 12);
            }
        }
        assert!(dark < 6, "{dark} of 120 images are black");
    }

    #[test]
    fn parked_vehicles_pull_out_smoothly_and_nobody_drives_through_them() {
        let looks = DriveLooks { pull_out: true, ..Default::default() };
        let (mut left, mut seen) = (0, 0);
        for seed in 0..12 {
            let drive = Drive::new(&DriveOptions { seconds: 12.0, ..options(seed, looks) }).unwrap();
            let plain = Drive::new(&DriveOptions { seconds: 12.0, ..options(seed, DriveLooks::default()) }).unwrap();
            for time in [1.0, 4.0, 7.0, 10.0] {
                let (h, movers) = (1e-3, drive.movers(time));
                let (before, after) = (drive.movers(time - h), drive.movers(time + h));
                let parked = plain.movers(time);
                for m in movers.iter().filter(|m| m.moving) {
                    let find = |list: &[crate::world::Mover]| list.iter().find(|o| o.id == m.id).cloned();
                    let (Some(a), Some(b)) = (find(&before), find(&after)) else { continue };
                    let v = (b.map_from_object.translation - a.map_from_object.translation) / (2.0 * h);
                    assert!(v.distance(m.velocity_mps) < 0.03, "{m:?}: {v}");
                    left += usize::from(find(&parked).is_some_and(|p| !p.moving));
                }
                let frame = drive.render(1, time);
                let near = frame.depth.iter().filter(|d| **d > 0.0).fold(f32::INFINITY, |a, b| a.min(*b));
                assert!(near > 0.8, "seed {seed} at {time} s: {near} m");
                seen += usize::from(frame != plain.render(1, time));
            }
        }
        assert!(left > 20 && seen > 6, "{left} moving, {seen} of 48 images differ");
    }

    /// Points of flying solids, moved by their velocity for a moment, lie on the surface seen then.
    #[test]
    fn solids_move_as_their_velocity_says() {
        const DT: f64 = 0.004;
        let looks = DriveLooks { solids: true, ..Default::default() };
        let (mut drives, mut points, mut good, mut fast) = (0, 0, 0, 0);
        for seed in 0..120 {
            let drive = drive(seed, looks);
            if drive.solid_count() == 0 {
                continue;
            }
            drives += 1;
            for time in [0.2, 0.9, 1.6, 2.3] {
                let frame = drive.render(1, time);
                let later = drive.view(1, time + DT);
                let tracer = later.tracer(drive.sky());
                for i in 0..frame.depth.len() {
                    if !(8..16).contains(&frame.instance[i]) {
                        continue;
                    }
                    let flow = Vec3::from(frame.flow[i]);
                    let q = later.camera_from_local(map_point(&drive, 1, time, &frame, i) + flow.as_dvec3() * DT);
                    let Some((u, v)) = later.camera.project(q) else { continue };
                    if !(u > 0.0 && v > 0.0 && u < frame.width as f32 && v < frame.height as f32) {
                        continue;
                    }
                    points += 1;
                    fast += usize::from(flow.length() > 3.0);
                    good += usize::from((tracer.hit(u, v).depth() - q.z).abs() < 2e-3 * q.z + 2e-3);
                }
            }
        }
        assert!((12..40).contains(&drives), "{drives} of 120 drives have solids");
        assert!(
            points > 2000 && fast * 2 > points && good as f64 > 0.96 * points as f64,
            "{good} of {points}, {fast} fast"
        );
    }

    #[test]
    fn foliage_has_holes_that_stay_where_they_are() {
        // Static points seen twice agree as well as they do without holes.
        let textures = DriveLooks { textures: true, ..Default::default() };
        let agree = |looks: DriveLooks| {
            let (mut all, mut good) = (0, 0);
            for seed in 0..10 {
                let drive = drive(seed, looks);
                let frame = drive.render(1, 0.5);
                let later = drive.view(1, 0.504);
                let tracer = later.tracer(drive.sky());
                for i in (0..frame.depth.len()).filter(|&i| frame.sky[i] == 0 && frame.instance[i] == 0) {
                    let q = later.camera_from_local(map_point(&drive, 1, 0.5, &frame, i));
                    let Some((u, v)) = later.camera.project(q) else { continue };
                    if u > 0.0 && v > 0.0 && u < frame.width as f32 && v < frame.height as f32 {
                        all += 1;
                        good += usize::from((tracer.hit(u, v).depth() - q.z).abs() < 2e-3 * q.z + 2e-3);
                    }
                }
            }
            good as f64 / all as f64
        };
        let (plain, holes) = (agree(DriveLooks::default()), agree(textures));
        assert!(plain > 0.99 && holes > 0.985, "{plain} {holes}");
        let sky = |looks: DriveLooks| -> usize {
            (0..10).map(|seed| drive(seed, looks).render(1, 0.5).sky.iter().filter(|s| **s == 1).count()).sum()
        };
        assert!(sky(textures) > sky(DriveLooks::default()), "the sky is seen through trees");
    }

    #[test]
    fn rigs_look_ahead_and_differ() {
        let looks = DriveLooks { rigs: true, ..Default::default() };
        let mut heights = Vec::new();
        for cameras in 1..=6 {
            for seed in 0..20 {
                let options = DriveOptions { seed, cameras, looks, ..Default::default() };
                let drive = Drive::new(&options).unwrap();
                assert_eq!(drive.cameras().len(), cameras);
                let reference = &drive.cameras()[usize::from(cameras >= 3)];
                assert!(reference.base_from_camera.matrix3.z_axis.x > 0.8, "{cameras} cameras, seed {seed}");
                for c in drive.cameras() {
                    assert!(c.intrinsics.is_valid() && c.base_from_camera.matrix3.y_axis.z < -0.95);
                    heights.push(c.base_from_camera.translation.z);
                }
            }
        }
        heights.sort_by(f64::total_cmp);
        assert!(heights[0] < 1.25 && heights[heights.len() - 1] > 2.2);
    }
}
