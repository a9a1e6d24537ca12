//! From the camera's picture to the network's: region of interest, binning, lens and rectification undone, resized.
//!
//! Pixel centres: OpenCV and ROS put the centre of pixel 0 at coordinate 0, the renderer's [`Intrinsics`] at 0.5. Everything
//! here is in the latter, so `K` and `P` get half a pixel on entering.

use glam::{DMat3, DQuat, DVec3};
use storm_render::Intrinsics;

use super::RgbPicture;
use super::error::DecodeError;
use super::lens::Lens;
use super::resample::{AxisWeights, resample};
use super::rows::MAX_SIDE;
use super::warp::Warp;
use crate::msg::CameraInfo;

/// Centre of pixel 0 here minus its centre in OpenCV.
const HALF_PIXEL: f64 = 0.5;
/// Largest width or height of the output: the network's pictures are far smaller.
const MAX_OUTPUT_SIDE: usize = 8192;
/// How far `R * R^T` may be from the identity: calibration files are written with a few digits.
const ROTATION_TOLERANCE: f64 = 1e-3;
/// Rotations below this (radians) move no pixel of a 10,000-pixel camera by a tenth.
const NO_ROTATION_RAD: f64 = 1e-6;
/// A skew that moves no pixel of the picture by more than this is taken for rounding, pixels.
const NO_SKEW_PX: f64 = 0.01;

/// A pinhole in f64; pixel centres at +0.5.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Pinhole {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
}

#[derive(Debug, Clone)]
enum Path {
    /// No lens, no rotation: each axis on its own.
    Separable { cols: AxisWeights, rows: AxisWeights },
    /// Everything else.
    Warp(Warp),
}

/// Takes the pictures of one camera to the network's size, without distortion. Made once per camera; all maps are cached.
#[derive(Debug, Clone)]
pub struct Rectifier {
    intrinsics: Intrinsics,
    source: (usize, usize),
    rectified_from_camera: Option<DQuat>,
    path: Path,
}

impl Rectifier {
    /// For the camera of `info` and an output of `width` x `height`, each axis scaled on its own.
    ///
    /// The output shows the rectified camera: `P` when it is given, else `K`. `already_rectified` pictures (`image_rect`
    /// topics) are only resized; raw ones lose their distortion and, with `P`, are rotated by `R`
    /// (see [`Self::rectification`]). What the camera did not see is black.
    ///
    /// # Errors
    /// An uncalibrated camera, an unknown lens model, numbers that are not finite or not a camera, sizes that are refused.
    pub fn new(info: &CameraInfo, already_rectified: bool, width: usize, height: usize) -> Result<Self, DecodeError> {
        let wrong = |why: String| DecodeError::Camera { frame_id: info.header.frame_id.clone(), why };
        if !(1..=MAX_OUTPUT_SIDE).contains(&width) || !(1..=MAX_OUTPUT_SIDE).contains(&height) {
            return Err(wrong(format!("output size {width}x{height} is not within 1..={MAX_OUTPUT_SIDE}")));
        }
        let window = Window::of(info).map_err(wrong)?;
        let has_p = !info.p_is_unset();
        let from_p = || window.camera("P", [info.p[0], info.p[1], info.p[2], info.p[4], info.p[5], info.p[6]]);
        let from_k = || window.camera("K", [info.k[0], info.k[1], info.k[2], info.k[3], info.k[4], info.k[5]]);
        let rectified = if has_p { from_p() } else { from_k() }.map_err(wrong)?;
        let (raw, lens, rectified_from_camera) = if already_rectified {
            (rectified, Lens::Pinhole, None)
        } else {
            if info.k_is_unset() && has_p {
                return Err(wrong(
                    "K is zero, so its distortion cannot be undone; set input.rectified to true if its pictures are \
                     rectified already"
                        .into(),
                ));
            }
            let rotation = if has_p { rotation(&info.r).map_err(wrong)? } else { None };
            (from_k().map_err(wrong)?, Lens::from_info(info)?, rotation)
        };

        let (sw, sh) = (window.width as f64, window.height as f64);
        // Output pixels to pixels of the rectified picture, which is as large as the source.
        let (scale_x, scale_y) = (sw / width as f64, sh / height as f64);
        let path = if lens == Lens::Pinhole && rectified_from_camera.is_none() {
            let axis = |output: usize, source: usize, scale: f64, f: f64, c: f64, f_raw: f64, c_raw: f64| {
                AxisWeights::new(output, source, f_raw / f * scale, c_raw - f_raw / f * c)
            };
            Path::Separable {
                cols: axis(width, window.width, scale_x, rectified.fx, rectified.cx, raw.fx, raw.cx),
                rows: axis(height, window.height, scale_y, rectified.fy, rectified.cy, raw.fy, raw.cy),
            }
        } else {
            let limit = lens.limit();
            let camera_from_rectified = rectified_from_camera.map_or(DQuat::IDENTITY, |q| q.conjugate());
            Path::Warp(Warp::new((width, height), (window.width, window.height), |u, v| {
                let x = (u * scale_x - rectified.cx) / rectified.fx;
                let y = (v * scale_y - rectified.cy) / rectified.fy;
                let ray = camera_from_rectified * DVec3::new(x, y, 1.0);
                let inside = lens.off_axis(ray) <= limit;
                let (x, y) = lens.project(ray).filter(|_| inside)?;
                Some((raw.fx * x + raw.cx, raw.fy * y + raw.cy))
            }))
        };
        let intrinsics = Intrinsics {
            fx: (rectified.fx / scale_x) as f32,
            fy: (rectified.fy / scale_y) as f32,
            cx: (rectified.cx / scale_x) as f32,
            cy: (rectified.cy / scale_y) as f32,
            width,
            height,
        };
        // What is a camera in f64 may be none in the f32 that everything behind this works in.
        let k = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy];
        if !(k.iter().all(|x| x.is_finite()) && k[0].abs() >= f32::MIN_POSITIVE && k[1].abs() >= f32::MIN_POSITIVE) {
            return Err(wrong(format!("its focal lengths and centre {k:?} at {width}x{height} are no camera's")));
        }
        Ok(Self { intrinsics, source: (window.width, window.height), rectified_from_camera, path })
    }

    /// Intrinsics of the output picture.
    pub fn intrinsics(&self) -> Intrinsics {
        self.intrinsics
    }

    /// Width and height a source picture must have.
    pub fn source_size(&self) -> (usize, usize) {
        self.source
    }

    /// Rotation from the camera's optical frame to the frame the output is seen in (`R` of the camera_info), when there
    /// is one: the extrinsics of the output are `rectified_from_camera * camera_from_base`.
    pub fn rectification(&self) -> Option<DQuat> {
        self.rectified_from_camera
    }

    /// Per output pixel, row by row: whether the source image holds what it shows, by the middle of its footprint.
    pub fn inside(&self) -> Vec<bool> {
        match &self.path {
            Path::Separable { cols, rows } => {
                rows.inside().iter().flat_map(|&row| cols.inside().iter().map(move |&col| row && col)).collect()
            }
            Path::Warp(warp) => warp.inside(),
        }
    }

    /// Per output pixel, row by row: whether `valid`, one flag per pixel of the source image, holds for all of the source pixels
    /// that it is mixed of (up to one part in fifty); a mask of another size than [`Self::source_size`] holds everywhere.
    pub fn carry(&self, valid: &[bool]) -> Vec<bool> {
        /// Of 255: a mixture darkened by less cannot be told from rounding.
        const WHOLE: u8 = 250;
        let (width, height) = self.source;
        let data = valid.iter().flat_map(|&v| [if v { u8::MAX } else { 0 }; 3]).collect();
        let mixed = self.apply(&RgbPicture { width, height, data });
        match mixed {
            // What lies outside of the source is not this mask's to say.
            Ok(out) => {
                out.data.chunks_exact(3).zip(self.inside()).map(|(x, inside)| !inside || x[0] >= WHOLE).collect()
            }
            Err(_) => vec![true; self.intrinsics.width * self.intrinsics.height],
        }
    }

    /// The output picture.
    ///
    /// # Errors
    /// A picture of another size than [`Self::source_size`].
    pub fn apply(&self, picture: &RgbPicture) -> Result<RgbPicture, DecodeError> {
        let (want_width, want_height) = self.source;
        let right_size =
            (picture.width, picture.height) == self.source && picture.data.len() == want_width * want_height * 3;
        if !right_size {
            let (width, height) = (picture.width, picture.height);
            return Err(DecodeError::Size { width, height, want_width, want_height });
        }
        Ok(match &self.path {
            Path::Separable { cols, rows } => resample(picture, cols, rows),
            Path::Warp(warp) => warp.apply(picture),
        })
    }
}

/// The part of the sensor a picture shows, after region of interest and binning.
struct Window {
    x: f64,
    y: f64,
    binning_x: f64,
    binning_y: f64,
    width: usize,
    height: usize,
    full_width: f64,
    full_height: f64,
}

impl Window {
    fn of(info: &CameraInfo) -> Result<Self, String> {
        let [x, y, mut height, mut width] = info.roi;
        if width == 0 && height == 0 {
            (width, height) = (info.width.saturating_sub(x), info.height.saturating_sub(y));
        }
        let (full_w, full_h) = (info.width, info.height);
        if full_w == 0 || full_h == 0 || full_w > MAX_SIDE || full_h > MAX_SIDE {
            return Err(format!("picture size {full_w}x{full_h} is not within 1..={MAX_SIDE}"));
        }
        let fits = |at: u32, size: u32, full: u32| size > 0 && at.checked_add(size).is_some_and(|end| end <= full);
        if !fits(x, width, full_w) || !fits(y, height, full_h) {
            return Err(format!("region of interest {width}x{height} at {x},{y} is not inside {full_w}x{full_h}"));
        }
        let (binning_x, binning_y) = (info.binning_x.max(1), info.binning_y.max(1));
        let (w, h) = (width / binning_x, height / binning_y);
        if w == 0 || h == 0 {
            return Err(format!("binning {binning_x}x{binning_y} leaves nothing of {width}x{height}"));
        }
        let (binning_x, binning_y) = (f64::from(binning_x), f64::from(binning_y));
        let (full_width, full_height) = (full_w.into(), full_h.into());
        let (width, height) = (w as usize, h as usize);
        Ok(Self { x: x.into(), y: y.into(), binning_x, binning_y, width, height, full_width, full_height })
    }

    /// The pinhole of two matrix rows `[fx, skew, cx, _, fy, cy]` given for the full picture in OpenCV's convention.
    fn camera(&self, name: &str, [fx, skew, cx, turned_skew, fy, cy]: [f64; 6]) -> Result<Pinhole, String> {
        if fx == 0.0 && fy == 0.0 {
            return Err(format!("the camera is not calibrated ({name} is zero)"));
        }
        let usable = [fx, fy, cx, cy].iter().all(|x| x.is_finite()) && fx > 0.0 && fy > 0.0;
        if !usable {
            return Err(format!("{name} is not a camera: fx {fx}, fy {fy}, cx {cx}, cy {cy}"));
        }
        // The farthest a pixel moves: by x of a skew times y of the normalised plane, and the other way about.
        let (rows, columns) = (self.full_height / fy, self.full_width / fx);
        for (skew, reach) in [(skew, rows), (turned_skew, columns)] {
            let is_rounding = (skew * reach).abs() <= NO_SKEW_PX;
            if !is_rounding {
                return Err(format!("{name} has skew {skew}; only cameras without skew are accepted"));
            }
        }
        Ok(Pinhole {
            fx: fx / self.binning_x,
            fy: fy / self.binning_y,
            cx: (cx + HALF_PIXEL - self.x) / self.binning_x,
            cy: (cy + HALF_PIXEL - self.y) / self.binning_y,
        })
    }
}

/// `R` as a rotation, `None` when it turns nothing (or is left at zero).
fn rotation(r: &[f64; 9]) -> Result<Option<DQuat>, String> {
    if r.iter().all(|x| *x == 0.0) {
        return Ok(None);
    }
    let m = DMat3::from_cols_array(r).transpose();
    let off = m * m.transpose() - DMat3::IDENTITY;
    let is_rotation = off.to_cols_array().iter().all(|x| x.abs() <= ROTATION_TOLERANCE) && m.determinant() > 0.0;
    if !is_rotation {
        return Err(format!("R is not a rotation: {r:?}"));
    }
    let q = DQuat::from_mat3(&m).normalize();
    Ok((2.0 * q.xyz().length() > NO_ROTATION_RAD).then_some(q))
}

#[cfg(test)]
#[path = "rectify_tests.rs"]
mod tests;
