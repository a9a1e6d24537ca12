//! What the network sees: a window of posed pictures.

use candle_core::{DType, Device, Tensor};
use glam::Affine3A;
use storm_render::Intrinsics;

use crate::config::{MAX_CAMERAS, MAX_TIMESTEPS};
use crate::error::ModelError;

/// `b` windows of `t` timesteps and `v` cameras, as tensors.
///
/// The world is the window's anchor frame: placed at the reference (front) camera of the first timestep, x forward, y
/// left, z up, metres.
#[derive(Debug, Clone)]
pub struct ClipBatch {
    /// `(b, t, v, 3, h, w)`, colours in -1..1.
    pub image: Tensor,
    /// `(b, t, v, 3, 3)`, pixels of `image`.
    pub intrinsics: Tensor,
    /// `(b, t, v, 4, 4)`, row-major; takes camera optical coordinates to the world.
    pub world_from_camera: Tensor,
    /// `(b, t, v)`, seconds since the window's first timestep.
    pub time_sec: Tensor,
    /// `(b, t, v, h, w)`: 1 where the camera saw something, 0 where the picture only fills a gap; none: 1 everywhere.
    pub valid: Option<Tensor>,
    /// Seconds that count as 1 in the time embedding (2.0 in the paper).
    pub timespan_sec: f64,
    /// An image shortly before each of `image`, of the same shape, for a velocity sweep; they are never tokens. None: there are none.
    pub prior: Option<Box<ClipBatch>>,
}

/// Order of the numbers in a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelLayout {
    /// Row, column, channel.
    Hwc,
    /// Channel, row, column.
    Chw,
}

/// One camera's picture at one timestep.
#[derive(Debug, Clone, Copy)]
pub struct ViewInput<'a> {
    /// Colours in -1..1, `3 * width * height` numbers.
    pub rgb: &'a [f32],
    /// The camera, in pixels of this picture.
    pub intrinsics: Intrinsics,
    /// The camera's pose in the window's world.
    pub world_from_camera: Affine3A,
    /// Seconds since the window's first timestep.
    pub time_sec: f32,
    /// Whether the camera saw the pixel, `width * height` of them, row by row; none: it saw all.
    pub valid: Option<&'a [bool]>,
}

impl ClipBatch {
    /// One window from plain pictures, `views[timestep][camera]`.
    ///
    /// # Errors
    /// When counts or sizes differ between timesteps or cameras, a count is out of range, or a value is not finite
    /// (the error names the camera and the timestep).
    pub fn from_views(
        views: &[Vec<ViewInput<'_>>],
        layout: PixelLayout,
        timespan_sec: f64,
        device: &Device,
    ) -> Result<Self, ModelError> {
        let (t, v) = (views.len(), views.first().map_or(0, Vec::len));
        check_counts(t, v)?;
        let (width, height) = (views[0][0].intrinsics.width, views[0][0].intrinsics.height);
        let count = width.checked_mul(height).and_then(|n| n.checked_mul(3)).unwrap_or(usize::MAX);
        if !(timespan_sec.is_finite() && timespan_sec > 0.0) {
            return Err(ModelError::Input(format!("timespan_sec is {timespan_sec}; use a positive number")));
        }
        for (timestep, row) in views.iter().enumerate() {
            if row.len() != v {
                let text = format!("timestep {timestep} has {} cameras, timestep 0 has {v}", row.len());
                return Err(ModelError::Input(text));
            }
            for (camera, view) in row.iter().enumerate() {
                check_view(view, camera, timestep, [width, height], count)?;
            }
        }
        let all = || views.iter().flatten();
        let mut image = Vec::with_capacity(t * v * count);
        for view in all() {
            match layout {
                PixelLayout::Chw => image.extend_from_slice(view.rgb),
                PixelLayout::Hwc => (0..3).for_each(|c| image.extend(view.rgb[c..].iter().step_by(3))),
            }
        }
        let intrinsics: Vec<f32> = all().flat_map(|x| x.intrinsics.matrix().concat()).collect();
        let poses: Vec<f32> = all().flat_map(|x| pose_rows(&x.world_from_camera)).collect();
        let times: Vec<f32> = all().map(|x| x.time_sec).collect();
        let valid = match all().any(|x| x.valid.is_some()) {
            true => {
                let seen = |x: &ViewInput<'_>, i: usize| f32::from(u8::from(x.valid.is_none_or(|valid| valid[i])));
                let values: Vec<f32> = all().flat_map(|x| (0..width * height).map(move |i| seen(x, i))).collect();
                Some(Tensor::from_vec(values, (1, t, v, height, width), device)?)
            }
            false => None,
        };
        Ok(Self {
            image: Tensor::from_vec(image, (1, t, v, 3, height, width), device)?,
            intrinsics: Tensor::from_vec(intrinsics, (1, t, v, 3, 3), device)?,
            world_from_camera: Tensor::from_vec(poses, (1, t, v, 4, 4), device)?,
            time_sec: Tensor::from_vec(times, (1, t, v), device)?,
            valid,
            timespan_sec,
            prior: None,
        })
    }

    /// The same windows in another type, f64 for a reference of what f32 loses.
    pub fn to_dtype(&self, dtype: DType) -> Result<Self, ModelError> {
        Ok(Self {
            image: self.image.to_dtype(dtype)?,
            intrinsics: self.intrinsics.to_dtype(dtype)?,
            world_from_camera: self.world_from_camera.to_dtype(dtype)?,
            time_sec: self.time_sec.to_dtype(dtype)?,
            valid: self.valid.as_ref().map(|x| x.to_dtype(dtype)).transpose()?,
            timespan_sec: self.timespan_sec,
            prior: self.map_prior(|prior| prior.to_dtype(dtype))?,
        })
    }

    fn map_prior(&self, to: impl Fn(&Self) -> Result<Self, ModelError>) -> Result<Option<Box<Self>>, ModelError> {
        self.prior.as_ref().map(|prior| to(prior).map(Box::new)).transpose()
    }

    /// Several windows of the same shape and timespan as one batch.
    pub fn stack(clips: &[Self]) -> Result<Self, ModelError> {
        let first = clips.first().ok_or_else(|| ModelError::Input("no clips to stack".into()))?;
        if let Some(other) = clips.iter().find(|c| c.timespan_sec != first.timespan_sec) {
            let text = format!("timespans {} and {} s differ in one batch", first.timespan_sec, other.timespan_sec);
            return Err(ModelError::Input(text));
        }
        let cat = |pick: fn(&Self) -> &Tensor| Tensor::cat(&clips.iter().map(pick).collect::<Vec<_>>(), 0);
        Ok(Self {
            image: cat(|c| &c.image)?,
            intrinsics: cat(|c| &c.intrinsics)?,
            world_from_camera: cat(|c| &c.world_from_camera)?,
            time_sec: cat(|c| &c.time_sec)?,
            valid: cat_valid(clips.iter().map(|c| (c.valid.as_ref(), &c.image)), 0)?,
            timespan_sec: first.timespan_sec,
            prior: match clips.iter().map(|c| c.prior.as_deref().cloned()).collect::<Option<Vec<_>>>() {
                Some(priors) => Some(Box::new(Self::stack(&priors)?)),
                // Windows with and without them are alike only without.
                None => None,
            },
        })
    }

    /// Window `index` of the batch, as a batch of one.
    pub(crate) fn window(&self, index: usize) -> Result<Self, ModelError> {
        Ok(Self {
            image: self.image.narrow(0, index, 1)?,
            intrinsics: self.intrinsics.narrow(0, index, 1)?,
            world_from_camera: self.world_from_camera.narrow(0, index, 1)?,
            time_sec: self.time_sec.narrow(0, index, 1)?,
            valid: self.valid.as_ref().map(|x| x.narrow(0, index, 1)).transpose()?,
            timespan_sec: self.timespan_sec,
            prior: self.map_prior(|prior| prior.window(index))?,
        })
    }

    /// One timestep of every window, which keeps its time and its poses.
    pub(crate) fn timestep(&self, t: usize) -> Result<Self, ModelError> {
        Ok(Self {
            image: self.image.narrow(1, t, 1)?.contiguous()?,
            intrinsics: self.intrinsics.narrow(1, t, 1)?,
            world_from_camera: self.world_from_camera.narrow(1, t, 1)?,
            time_sec: self.time_sec.narrow(1, t, 1)?,
            valid: self.valid.as_ref().map(|x| x.narrow(1, t, 1)).transpose()?,
            timespan_sec: self.timespan_sec,
            prior: self.map_prior(|prior| prior.timestep(t))?,
        })
    }

    /// `(b, t, v, h, w)`, after checking that all tensors agree.
    pub(crate) fn dims(&self) -> Result<[usize; 5], ModelError> {
        let &[b, t, v, 3, h, w] = self.image.dims() else {
            return Err(ModelError::Input(format!(
                "image has shape {:?}, expected (b, t, v, 3, h, w)",
                self.image.dims()
            )));
        };
        check_counts(t, v)?;
        let expected: [(&str, &Tensor, Vec<usize>); 3] = [
            ("intrinsics", &self.intrinsics, vec![b, t, v, 3, 3]),
            ("world_from_camera", &self.world_from_camera, vec![b, t, v, 4, 4]),
            ("time_sec", &self.time_sec, vec![b, t, v]),
        ];
        let valid = self.valid.as_ref().map(|x| ("valid", x, vec![b, t, v, h, w]));
        for (name, tensor, shape) in expected.into_iter().chain(valid) {
            if tensor.dims() != shape {
                return Err(ModelError::Input(format!("{name} has shape {:?}, expected {shape:?}", tensor.dims())));
            }
        }
        if let Some(prior) = &self.prior {
            let shape = prior.dims()?;
            if shape != [b, t, v, h, w] {
                let text =
                    format!("prior images have shape {shape:?} (b, t, v, h, w), the window {:?}", [b, t, v, h, w]);
                return Err(ModelError::Input(text));
            }
        }
        Ok([b, t, v, h, w])
    }
}

/// Validity masks one after the other along an axis, each beside a tensor `(b, t, v, ..)` of its windows and timesteps; a part
/// without a mask is valid everywhere, and none is needed where no part has one.
pub(crate) fn cat_valid<'a>(
    parts: impl Iterator<Item = (Option<&'a Tensor>, &'a Tensor)> + Clone,
    axis: usize,
) -> candle_core::Result<Option<Tensor>> {
    let Some((h, w)) = parts.clone().find_map(|(valid, _)| valid).map(|x| (x.dims()[3], x.dims()[4])) else {
        return Ok(None);
    };
    let whole = |(valid, like): (Option<&Tensor>, &Tensor)| match valid {
        Some(valid) => Ok(valid.clone()),
        None => Tensor::ones((like.dim(0)?, like.dim(1)?, like.dim(2)?, h, w), like.dtype(), like.device()),
    };
    let all = parts.map(whole).collect::<candle_core::Result<Vec<_>>>()?;
    Ok(Some(Tensor::cat(&all, axis)?))
}

fn check_counts(timesteps: usize, cameras: usize) -> Result<(), ModelError> {
    if !(1..=MAX_TIMESTEPS).contains(&timesteps) {
        return Err(ModelError::Input(format!("{timesteps} timesteps in a window; use 1 to {MAX_TIMESTEPS}")));
    }
    if !(1..=MAX_CAMERAS).contains(&cameras) {
        return Err(ModelError::Input(format!("{cameras} cameras in a window; use 1 to {MAX_CAMERAS}")));
    }
    Ok(())
}

fn check_view(
    view: &ViewInput<'_>,
    camera: usize,
    timestep: usize,
    size: [usize; 2],
    count: usize,
) -> Result<(), ModelError> {
    let k = &view.intrinsics;
    let place = format!("camera {camera} at timestep {timestep}");
    if [k.width, k.height] != size {
        let text = format!("{place} is {}x{} pixels, the first picture {}x{}", k.width, k.height, size[0], size[1]);
        return Err(ModelError::Input(text));
    }
    if view.rgb.len() != count {
        let text = format!("{place} has {} colour values, {}x{} pixels need {count}", view.rgb.len(), size[0], size[1]);
        return Err(ModelError::Input(text));
    }
    if let Some(valid) = view.valid
        && Some(valid.len()) != size[0].checked_mul(size[1])
    {
        let text = format!("{place} has {} marks of validity for {}x{} pixels", valid.len(), size[0], size[1]);
        return Err(ModelError::Input(text));
    }
    let pose = pose_rows(&view.world_from_camera);
    let time = [view.time_sec];
    let intrinsics = k.matrix().concat();
    let parts: [(&str, &[f32]); 4] =
        [("image", view.rgb), ("intrinsics", &intrinsics), ("pose", &pose), ("time", &time)];
    for (what, values) in parts {
        let count = values.iter().filter(|x| !x.is_finite()).count();
        if count > 0 {
            return Err(ModelError::NonFiniteInput { what, camera, timestep, count });
        }
    }
    if k.is_valid() {
        return Ok(());
    }
    Err(ModelError::Input(format!("{place} has focal lengths {} and {}; both must be positive", k.fx, k.fy)))
}

/// Row-major 4 x 4.
fn pose_rows(pose: &Affine3A) -> [f32; 16] {
    let (r, p) = (pose.matrix3.transpose(), pose.translation);
    let rows = [r.x_axis, r.y_axis, r.z_axis];
    let mut out = [0.0; 16];
    for (k, row) in rows.iter().enumerate() {
        out[4 * k..4 * k + 3].copy_from_slice(&row.to_array());
        out[4 * k + 3] = p[k];
    }
    out[15] = 1.0;
    out
}

#[cfg(test)]
mod tests {
    use glam::{Quat, Vec3};

    use super::*;

    fn view(rgb: &[f32]) -> ViewInput<'_> {
        let intrinsics = Intrinsics { fx: 5.0, fy: 6.0, cx: 1.0, cy: 0.5, width: 2, height: 1 };
        let pose = Affine3A::from_rotation_translation(Quat::from_rotation_z(0.3), Vec3::new(1.0, 2.0, 3.0));
        ViewInput { rgb, intrinsics, world_from_camera: pose, time_sec: 0.25, valid: None }
    }

    #[test]
    fn both_layouts_and_the_pose_arrive() {
        let (hwc, chw) = ([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [0.1, 0.4, 0.2, 0.5, 0.3, 0.6]);
        let a = ClipBatch::from_views(&[vec![view(&hwc)]], PixelLayout::Hwc, 2.0, &Device::Cpu).unwrap();
        let b = ClipBatch::from_views(&[vec![view(&chw)]], PixelLayout::Chw, 2.0, &Device::Cpu).unwrap();
        let flat = |x: &Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(flat(&a.image), flat(&b.image));
        assert_eq!(flat(&a.image), chw);
        let m = flat(&a.world_from_camera);
        assert_eq!([m[3], m[7], m[11], m[15]], [1.0, 2.0, 3.0, 1.0]);
        assert!((m[0] - 0.3f32.cos()).abs() < 1e-6 && (m[1] + 0.3f32.sin()).abs() < 1e-6);
        assert!(a.valid.is_none());
        assert_eq!(ClipBatch::stack(&[a, b]).unwrap().dims().unwrap(), [2, 1, 1, 1, 2]);
    }

    #[test]
    fn a_mask_travels_with_its_pictures() {
        let rgb = [0.1; 6];
        let make = |valid| {
            let views = [vec![view(&rgb)], vec![ViewInput { valid, ..view(&rgb) }]];
            ClipBatch::from_views(&views, PixelLayout::Hwc, 2.0, &Device::Cpu)
        };
        let (masked, whole) = (make(Some(&[true, false])).unwrap(), make(None).unwrap());
        let flat = |x: &ClipBatch| x.valid.as_ref().unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(flat(&masked), [1.0, 1.0, 1.0, 0.0]);
        assert_eq!(flat(&masked.timestep(1).unwrap()), [1.0, 0.0]);
        let both = ClipBatch::stack(&[whole, masked]).unwrap();
        assert_eq!(both.dims().unwrap(), [2, 2, 1, 1, 2]);
        assert_eq!(flat(&both), [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0]);
        assert_eq!(flat(&both.window(1).unwrap()), [1.0, 1.0, 1.0, 0.0]);
        assert!(make(Some(&[true])).is_err());
    }

    #[test]
    fn broken_inputs_name_camera_and_timestep() {
        let good = [0.0; 6];
        let bad = [0.0, f32::NAN, 0.0, 0.0, f32::INFINITY, 0.0];
        let make = |second: ViewInput<'_>| {
            ClipBatch::from_views(&[vec![view(&good), second]], PixelLayout::Hwc, 2.0, &Device::Cpu)
        };
        let error = make(view(&bad)).unwrap_err().to_string();
        assert!(error.contains("camera 1") && error.contains("image") && error.contains('2'), "{error}");
        let mut lost = view(&good);
        lost.world_from_camera.translation.x = f32::NAN;
        assert!(matches!(
            make(lost),
            Err(ModelError::NonFiniteInput { what: "pose", camera: 1, timestep: 0, count: 1 })
        ));
        let mut flat = view(&good);
        flat.intrinsics.fx = 0.0;
        assert!(make(flat).is_err());
        assert!(make(view(&good[..3])).is_err());
        assert!(ClipBatch::from_views(&[], PixelLayout::Hwc, 2.0, &Device::Cpu).is_err());
        let rows: Vec<_> = (0..11).map(|_| vec![view(&good)]).collect();
        assert!(ClipBatch::from_views(&rows, PixelLayout::Hwc, 2.0, &Device::Cpu).is_err());
        assert!(ClipBatch::from_views(&[vec![view(&good)]], PixelLayout::Hwc, f64::NAN, &Device::Cpu).is_err());
    }
}
