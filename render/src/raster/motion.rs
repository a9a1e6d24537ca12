//! Motion (paper eq. 1): a Gaussian seen at `t` and drawn at `t'` stands at `mean + (t' - t) v`, with its backward velocity
//! for earlier and its forward velocity for later times. So a velocity receives `t' - t` times the moved mean's gradient.

use super::RasterError;

/// How Gaussians move; one row for each.
#[derive(Debug, Clone, Copy)]
pub struct Motion<'a> {
    /// Velocity before `time_sec`, m/s.
    pub velocity_backward: &'a [[f32; 3]],
    /// Velocity after `time_sec`, m/s.
    pub velocity_forward: &'a [[f32; 3]],
    /// When each Gaussian stood at its mean, seconds.
    pub time_sec: &'a [f32],
}

impl Motion<'_> {
    /// Checks that there is a row for each of `splats` Gaussians.
    ///
    /// # Errors
    /// The array that differs.
    pub fn validate(&self, splats: usize) -> Result<(), RasterError> {
        let lengths = [
            ("velocity_backward", self.velocity_backward.len()),
            ("velocity_forward", self.velocity_forward.len()),
            ("time_sec", self.time_sec.len()),
        ];
        match lengths.into_iter().find(|&(_, len)| len != splats) {
            Some((name, len)) => Err(RasterError::Length { name, len, expected: splats, splats }),
            None => Ok(()),
        }
    }

    /// Where Gaussian `i`, seen at `mean`, stands at `draw_sec`.
    #[inline(always)]
    pub(crate) fn place(&self, i: usize, mean: &[f32; 3], draw_sec: f32) -> [f32; 3] {
        moved(mean, &self.velocity_backward[i], &self.velocity_forward[i], draw_sec - self.time_sec[i])
    }
}

/// A mean `dt` seconds after it was seen.
#[inline(always)]
fn moved(mean: &[f32; 3], backward: &[f32; 3], forward: &[f32; 3], dt: f32) -> [f32; 3] {
    let v = if dt < 0.0 { backward } else { forward };
    [mean[0] + dt * v[0], mean[1] + dt * v[1], mean[2] + dt * v[2]]
}

/// Gradient of a loss with respect to the velocities of [`Gaussians`](crate::Gaussians), per m/s; sums over the times
/// drawn. A model with one velocity for both directions takes `backward + forward`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct VelocityGradients {
    /// Of `velocity_backward`, from the times before a Gaussian's own.
    pub backward: Vec<[f32; 3]>,
    /// Of `velocity_forward`, from the times after it.
    pub forward: Vec<[f32; 3]>,
}

impl VelocityGradients {
    /// Zeros for `n` Gaussians.
    pub fn zeros(n: usize) -> Self {
        Self { backward: vec![[0.0; 3]; n], forward: vec![[0.0; 3]; n] }
    }

    /// Adds what pictures of time `draw_sec` gave to the moved means (`SplatGradients::means`, one row per Gaussian);
    /// `seen_sec` are the Gaussians' own times. Times that are not finite, whose means were never drawn, add nothing.
    ///
    /// # Errors
    /// Arrays of different lengths.
    pub fn add(&mut self, draw_sec: f32, seen_sec: &[f32], means: &[[f32; 3]]) -> Result<(), RasterError> {
        let splats = means.len();
        let lengths = [
            ("times", seen_sec.len()),
            ("backward velocity gradients", self.backward.len()),
            ("forward velocity gradients", self.forward.len()),
        ];
        for (name, len) in lengths {
            if len != splats {
                return Err(RasterError::Length { name, len, expected: splats, splats });
            }
        }
        let velocities = self.backward.iter_mut().zip(&mut self.forward);
        for ((backward, forward), (seen, mean)) in velocities.zip(seen_sec.iter().zip(means)) {
            let dt = draw_sec - seen;
            let velocity = if dt < 0.0 { backward } else { forward };
            if dt.is_finite() {
                for (v, m) in velocity.iter_mut().zip(mean) {
                    *v += dt * m;
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Gaussians;

    #[test]
    fn each_direction_receives_its_own_times() {
        let mut g = VelocityGradients::zeros(3);
        let seen = [0.0, 1.0, 2.0];
        let means = [[1.0, 0.0, -2.0]; 3];
        g.add(1.0, &seen, &means).unwrap();
        assert_eq!(g.forward, [[1.0, 0.0, -2.0], [0.0; 3], [0.0; 3]]);
        assert_eq!(g.backward, [[0.0; 3], [0.0; 3], [-1.0, 0.0, 2.0]]);
        g.add(1.5, &seen, &means).unwrap();
        assert_eq!(g.forward[0], [2.5, 0.0, -5.0]);
        assert_eq!(g.forward[1], [0.5, 0.0, -1.0]);
        assert_eq!(g.backward[2], [-1.5, 0.0, 3.0]);
    }

    #[test]
    fn they_are_the_slopes_of_the_moved_mean() {
        let mut scene = Gaussians {
            means: vec![[1.0, 2.0, 3.0]; 2],
            velocity_backward: vec![[0.5, -1.0, 0.25], [2.0, 0.5, 1.0]],
            velocity_forward: vec![[-0.5, 1.0, 4.0], [1.0, 8.0, 0.5]],
            time_sec: vec![0.5, 1.5],
            ..Default::default()
        };
        // A loss that is linear in the moved means.
        let upstream = [[1.0f32, -2.0, 0.5], [0.25, 3.0, -1.0]];
        let loss = |scene: &Gaussians| -> f32 {
            (0..2).map(|i| (0..3).map(|k| upstream[i][k] * scene.mean_at(i, 1.0)[k]).sum::<f32>()).sum()
        };
        let mut g = VelocityGradients::zeros(2);
        g.add(1.0, &scene.time_sec.clone(), &upstream).unwrap();
        let before = loss(&scene);
        for i in 0..2 {
            for k in 0..3 {
                scene.velocity_backward[i][k] += 1.0;
                assert_eq!(loss(&scene) - before, g.backward[i][k], "{i} {k}");
                scene.velocity_backward[i][k] -= 1.0;
                scene.velocity_forward[i][k] += 1.0;
                assert_eq!(loss(&scene) - before, g.forward[i][k], "{i} {k}");
                scene.velocity_forward[i][k] -= 1.0;
            }
        }
    }

    #[test]
    fn odd_times_and_lengths_do_no_harm() {
        let mut g = VelocityGradients::zeros(2);
        g.add(1.0, &[f32::NAN, f32::INFINITY], &[[1.0; 3]; 2]).unwrap();
        g.add(f32::NAN, &[0.0, 1.0], &[[1.0; 3]; 2]).unwrap();
        assert_eq!(g, VelocityGradients::zeros(2));
        assert!(matches!(g.add(1.0, &[0.0; 3], &[[1.0; 3]; 2]), Err(RasterError::Length { name: "times", .. })));
        assert!(g.add(1.0, &[0.0; 3], &[[1.0; 3]; 3]).is_err());
    }
}
