//! The error figures of one method, by the names the JSON files use.

use serde::Serialize;
use storm_model::metrics::image::ImageScores;

/// Figures of one method; `None` where nothing could be compared. Definitions: `storm_model::metrics`.
#[derive(Debug, Clone, Default, Serialize, PartialEq)]
pub struct Figures {
    /// dB, mean over images, without sky where the sky is known.
    pub psnr: Option<f64>,
    /// dB, moving pixels only.
    pub psnr_dynamic: Option<f64>,
    /// Structural similarity, without sky where the sky is known.
    pub ssim: Option<f64>,
    /// Structural similarity, moving pixels only.
    pub ssim_dynamic: Option<f64>,
    /// z-depth, metres.
    pub depth_rmse: Option<f64>,
    /// z-depth of moving pixels, metres.
    pub depth_rmse_dynamic: Option<f64>,
    /// z-depth of pixels no deeper than 75 m, as far as lidars reach, metres.
    pub depth_rmse_lidar: Option<f64>,
    /// End-point error of the flow on context frames, m/s.
    pub epe3d: Option<f64>,
    /// Share of points within 0.05 m/s or 5 %, 0 to 1.
    pub acc5: Option<f64>,
    /// Share of points within 0.1 m/s or 10 %, 0 to 1.
    pub acc10: Option<f64>,
    /// Mean angle between true and predicted flow of moving points, radians.
    pub theta: Option<f64>,
    /// Three-way end-point error: mean of the next three, m/s.
    pub epe3d_three_way: Option<f64>,
    /// End-point error of road users at 0.5 m/s or faster, m/s.
    pub epe3d_foreground_dynamic: Option<f64>,
    /// End-point error of other road users, m/s.
    pub epe3d_foreground_static: Option<f64>,
    /// End-point error of the surroundings, m/s.
    pub epe3d_background_static: Option<f64>,
    /// Share of moving road users' pixels that are missed (below 1 m/s, in truth above 2), 0 to 1.
    pub missed_share: Option<f64>,
    /// Foreground adjusted Rand index of the motion masks on context frames.
    pub fg_ari: Option<f64>,
    /// Intersection over union of moving pixels on context frames, 0 to 1.
    pub moving_iou: Option<f64>,
    /// Share of trajectory points within a distance, 0 to 1 (TAPVid-3D).
    pub apd3d: Option<f64>,
    /// Milliseconds per window.
    pub ms: Option<f64>,
}

impl Figures {
    /// Name, unit and value of each.
    pub fn rows(&self) -> [(&'static str, &'static str, Option<f64>); 20] {
        [
            ("PSNR", "dB", self.psnr),
            ("PSNR, moving", "dB", self.psnr_dynamic),
            ("SSIM", "", self.ssim),
            ("SSIM, moving", "", self.ssim_dynamic),
            ("depth RMSE", "m", self.depth_rmse),
            ("depth RMSE, moving", "m", self.depth_rmse_dynamic),
            ("depth RMSE to 75 m", "m", self.depth_rmse_lidar),
            ("EPE3D", "m/s", self.epe3d),
            ("Acc5", "", self.acc5),
            ("Acc10", "", self.acc10),
            ("angle", "rad", self.theta),
            ("EPE3D, three-way", "m/s", self.epe3d_three_way),
            ("EPE3D, moving users", "m/s", self.epe3d_foreground_dynamic),
            ("EPE3D, still users", "m/s", self.epe3d_foreground_static),
            ("EPE3D, background", "m/s", self.epe3d_background_static),
            ("movers missed", "", self.missed_share),
            ("foreground ARI", "", self.fg_ari),
            ("moving IoU", "", self.moving_iou),
            ("APD3D", "", self.apd3d),
            ("run time", "ms", self.ms),
        ]
    }

    /// Each, in the order of [`Self::rows`].
    pub(super) fn values_mut(&mut self) -> [&mut Option<f64>; 20] {
        [
            &mut self.psnr,
            &mut self.psnr_dynamic,
            &mut self.ssim,
            &mut self.ssim_dynamic,
            &mut self.depth_rmse,
            &mut self.depth_rmse_dynamic,
            &mut self.depth_rmse_lidar,
            &mut self.epe3d,
            &mut self.acc5,
            &mut self.acc10,
            &mut self.theta,
            &mut self.epe3d_three_way,
            &mut self.epe3d_foreground_dynamic,
            &mut self.epe3d_foreground_static,
            &mut self.epe3d_background_static,
            &mut self.missed_share,
            &mut self.fg_ari,
            &mut self.moving_iou,
            &mut self.apd3d,
            &mut self.ms,
        ]
    }

    /// Means over images, without sky where the sky is known.
    pub(super) fn of_images(scores: &[ImageScores]) -> Self {
        let m = ImageScores::mean(scores);
        Self {
            psnr: m.psnr_occupied.or(m.psnr),
            psnr_dynamic: m.psnr_dynamic,
            ssim: m.ssim_occupied.or(m.ssim),
            ssim_dynamic: m.ssim_dynamic,
            depth_rmse: m.depth_rmse,
            depth_rmse_dynamic: m.depth_rmse_dynamic,
            depth_rmse_lidar: m.depth_rmse_lidar,
            ..Self::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_and_values_are_in_one_order() {
        let mut figures = Figures::default();
        for (k, value) in figures.values_mut().into_iter().enumerate() {
            *value = Some(k as f64);
        }
        for (k, (name, _, value)) in figures.rows().into_iter().enumerate() {
            assert_eq!(value, Some(k as f64), "{name}");
        }
    }
}
