//! The Gaussians a window or a map is made of, as plain arrays (structure of arrays).

/// `n` Gaussians that move: positions at their own reference time and one velocity each way (paper eq. 1).
///
/// All arrays have length `n`, `motion_weights` `n * motion_count`. Metres, seconds, m/s; the frame is the caller's.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Gaussians {
    /// Centres at `time_sec`, metres.
    pub means: Vec<[f32; 3]>,
    /// Orientation quaternions w, x, y, z; need not be unit, the rasteriser normalises.
    pub quats: Vec<[f32; 4]>,
    /// Linear standard deviations along the local axes, metres.
    pub scales: Vec<[f32; 3]>,
    /// Opacity, 0 to 1.
    pub opacities: Vec<f32>,
    /// Colour as the network states it: -1 to 1 maps to black to white (it may lie outside).
    pub colors: Vec<[f32; 3]>,
    /// Velocity used for times before `time_sec`, m/s; equal to `velocity_forward` for one-velocity models.
    pub velocity_backward: Vec<[f32; 3]>,
    /// Velocity used for times after `time_sec`, m/s.
    pub velocity_forward: Vec<[f32; 3]>,
    /// Time the Gaussian was seen at, seconds since the window's first timestep.
    pub time_sec: Vec<f32>,
    /// Motion tokens per Gaussian; 0 when the model has none.
    pub motion_count: usize,
    /// Soft assignment to motion tokens, row-major `n x motion_count`, rows sum to 1.
    pub motion_weights: Vec<f32>,
}

impl Gaussians {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True when there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Centre of Gaussian `i` at `time_sec` (paper eq. 1: backward velocity for earlier times, forward for later).
    pub fn mean_at(&self, i: usize, time_sec: f32) -> [f32; 3] {
        let dt = time_sec - self.time_sec[i];
        let v = if dt < 0.0 { &self.velocity_backward[i] } else { &self.velocity_forward[i] };
        let m = &self.means[i];
        [m[0] + dt * v[0], m[1] + dt * v[1], m[2] + dt * v[2]]
    }

    /// Motion token with the largest weight (the first wins ties, as argmax does); 0 without motion tokens.
    pub fn motion_id(&self, i: usize) -> u16 {
        let w = &self.motion_weights[i * self.motion_count..(i + 1) * self.motion_count];
        let mut best = 0;
        for (k, &x) in w.iter().enumerate() {
            if x > w[best] {
                best = k;
            }
        }
        best as u16
    }
}
