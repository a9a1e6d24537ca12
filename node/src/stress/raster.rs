//! Gaussians at their limits, in the rasteriser and in its f64 reference.

use anyhow::Result;
use glam::Affine3A;
use storm_render::raster::{Convention, CpuRasterizer, RasterSettings, Splats, reference};
use storm_render::{Gaussians, Intrinsics, View};

use super::subject::Size;
use super::{Case, Finding, Sheet, worst};
use crate::dice::Dice;

/// Colours and opacities of the two, where neither stands on the edge of a decision.
const LIMIT: f64 = 2e-4;
/// What is left behind a pixel that is full, several times over.
const STACK_LIMIT: f64 = 5e-4;
/// Depth is compared over itself.
const DEPTH_FLOOR_M: f64 = 1.0;

struct Cloud(Gaussians);

impl Cloud {
    /// `n` ordinary Gaussians in front of the camera.
    fn ordinary(n: usize, seed: u64) -> Self {
        let mut dice = Dice::new(seed);
        let mut spread = |low: f32, high: f32| low + (high - low) * dice.unit();
        let mut g = Gaussians::default();
        for _ in 0..n {
            let z = spread(2.0, 40.0);
            g.means.push([spread(-0.5, 0.5) * z, spread(-0.4, 0.4) * z, z]);
            g.quats.push([spread(-1.0, 1.0), spread(-1.0, 1.0), spread(-1.0, 1.0), spread(0.1, 1.0)]);
            g.scales.push([spread(0.02, 0.5), spread(0.02, 0.5), spread(0.02, 0.5)]);
            g.opacities.push(spread(0.1, 1.0));
            g.colors.push([spread(0.0, 1.0), spread(0.0, 1.0), spread(0.0, 1.0)]);
            let v = [spread(-5.0, 5.0), spread(-5.0, 5.0), spread(-5.0, 5.0)];
            g.velocity_backward.push(v);
            g.velocity_forward.push(v);
            g.time_sec.push(0.0);
        }
        Self(g)
    }

    fn changed(mut self, change: impl Fn(usize, &mut Gaussians)) -> Self {
        (0..self.0.len()).for_each(|i| change(i, &mut self.0));
        self
    }

    /// Both rasterisers at a time, both conventions, undecided pixels left out.
    fn compare(&self, k: Intrinsics, time_sec: f32) -> Finding {
        self.compare_pixels(k, time_sec, false)
    }

    fn compare_pixels(&self, k: Intrinsics, time_sec: f32, undecided_too: bool) -> Finding {
        let mut finding = Finding::default();
        for convention in [Convention::Pinned, Convention::Latest] {
            let settings = RasterSettings { convention, ..RasterSettings::default() };
            finding.join(
                self.compare_by(settings, k, time_sec, undecided_too).unwrap_or_else(|e| super::subject::refused(&e)),
            );
        }
        finding
    }

    fn compare_by(
        &self,
        settings: RasterSettings,
        k: Intrinsics,
        time_sec: f32,
        undecided_too: bool,
    ) -> Result<Finding> {
        let means: Vec<[f32; 3]> = (0..self.0.len()).map(|i| self.0.mean_at(i, time_sec)).collect();
        let features: Vec<f32> = self.0.colors.iter().flatten().copied().collect();
        let (quats, scales, opacities) = (&self.0.quats[..], &self.0.scales[..], &self.0.opacities[..]);
        let splats = Splats { means: &means, quats, scales, opacities, features: &features, feature_count: 3 };
        let views = [View::from_pose(Affine3A::IDENTITY, k)];
        let fast = CpuRasterizer::new(settings)?.render(&splats, &views)?;
        let slow = reference::render_with_fragile(&settings, &splats, &views)?;
        let mut finding = Finding::default();
        for (fast, (slow, fragile)) in fast.iter().zip(&slow) {
            let values = || fast.features.iter().chain(&fast.alpha).chain(&fast.depth);
            finding.nonfinite += values().filter(|x| !x.is_finite()).count() as u64;
            for pixel in (0..fast.alpha.len()).filter(|&p| undecided_too || !fragile[p]) {
                let gap = |a: f32, b: f32| f64::from((a - b).abs());
                let mut error = gap(fast.alpha[pixel], slow.alpha[pixel]);
                (0..3).for_each(|c| {
                    error = worst(error, gap(fast.features[3 * pixel + c], slow.features[3 * pixel + c]))
                });
                let depth = f64::from(slow.depth[pixel]);
                error = worst(error, gap(fast.depth[pixel], slow.depth[pixel]) / (DEPTH_FLOOR_M + depth));
                finding.worst_error = worst(finding.worst_error, error);
            }
        }
        Ok(finding)
    }
}

pub fn run(size: Size, found: &mut dyn FnMut(Case)) -> Result<()> {
    let (n, crowd, width, height) = match size {
        Size::Full => (2_000, 1_000_000, 96, 64),
        Size::Reduced => (300, 20_000, 48, 32),
    };
    let k = Intrinsics::from_fov(70.0, width, height);
    let mut sheet = Sheet {
        group: "rasteriser",
        against: "f64 rasteriser, absolute, undecided pixels left out",
        limit: LIMIT,
        found,
    };
    let cloud = |seed: u64| Cloud::ordinary(n, seed);
    sheet.add("ordinary Gaussians", cloud(1).compare(k, 0.0));
    for scale in [0.0, 1e-9, 1e3, 1e9] {
        let one = cloud(2).changed(|i, g| g.scales[i] = [scale; 3]);
        sheet.add(format!("scales of {scale:e} m"), one.compare(k, 0.0));
    }
    let needles = cloud(3).changed(|i, g| g.scales[i] = [10.0, 1e-4, 1e-4]);
    sheet.add("needles 10 m long and 0.1 mm thick", needles.compare(k, 0.0));
    for size in [1e-30, 1e-15, 1e15, 1e18] {
        let one = cloud(4).changed(|i, g| g.quats[i] = g.quats[i].map(|x| x * size));
        sheet.add(format!("quaternions of length {size:e}"), one.compare(k, 0.0));
    }
    let none = cloud(5).changed(|i, g| {
        if i % 2 == 0 {
            g.quats[i] = [0.0; 4]
        }
    });
    sheet.add("every other quaternion 0", none.compare(k, 0.0));
    for opacity in [0.0, 1.0 / 255.0, 1.0] {
        let one = cloud(6).changed(|i, g| g.opacities[i] = opacity);
        sheet.add(format!("opacity {opacity:.3}"), one.compare(k, 0.0));
    }
    let broken = cloud(7).changed(|i, g| match i % 5 {
        0 => g.means[i][1] = f32::NAN,
        1 => g.scales[i][0] = f32::INFINITY,
        2 => g.opacities[i] = f32::NAN,
        3 => g.quats[i][2] = f32::NEG_INFINITY,
        _ => {}
    });
    sheet.add("four of five Gaussians not finite", broken.compare(k, 0.0));
    let near = RasterSettings::default().near;
    let plane = cloud(8).changed(|i, g| g.means[i][2] = near * (1.0 + 1e-6 * (i % 7) as f32 - 3e-6));
    sheet.add("on the near plane", plane.compare(k, 0.0));
    let far = RasterSettings::default().far;
    let plane = cloud(9).changed(|i, g| g.means[i][2] = far * (1.0 + 1e-6 * (i % 7) as f32 - 3e-6));
    sheet.add("on the far plane", plane.compare(k, 0.0));
    let same = cloud(10).changed(|i, g| g.means[i][2] = 10.0);
    sheet.add("all at one depth", same.compare(k, 0.0));
    for (name, v, time) in [
        ("100 m/s across, after 2 s", [100.0, 0.0, 0.0], 2.0),
        ("100 m/s towards the camera and through it", [0.0, 0.0, -100.0], 0.25),
        ("1e30 m/s", [1e30, -1e30, 1e30], 1.0),
    ] {
        let fast = cloud(11).changed(|i, g| (g.velocity_forward[i], g.velocity_backward[i]) = (v, v));
        sheet.add(name, fast.compare(k, time));
    }
    // All on the middle of one pixel, behind each other; faint ones, so that the sum is long.
    let stack = Cloud::ordinary(crowd, 12).changed(|i, g| {
        let z = 5.0 + 30.0 * i as f32 / crowd as f32;
        let (u, v) = ((width / 2) as f32 + 0.5 - k.cx, (height / 2) as f32 + 0.5 - k.cy);
        g.means[i] = [z * u / k.fx, z * v / k.fy, z];
        g.scales[i] = [1e-4; 3];
        g.opacities[i] = if i % 2 == 0 { 0.01 } else { 0.005 };
    });
    // Where the sum ends is always undecided by a Gaussian or two, which is worth what the last ones are worth.
    let name = format!("{crowd} Gaussians on one pixel, undecided or not");
    sheet.add_within(name, STACK_LIMIT, stack.compare_pixels(k, 0.0, true));
    Ok(())
}
