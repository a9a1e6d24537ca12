//! The views of a clip as the rasteriser takes them.

use candle_core::{Device, Tensor};
use glam::{Affine3A, Mat3A, Vec3A};
use storm_render::{Intrinsics, View};

use crate::clip::ClipBatch;
use crate::error::ModelError;

/// In the order (window, timestep, camera).
pub(super) fn views(clip: &ClipBatch) -> Result<Vec<View>, ModelError> {
    let [_, _, _, height, width] = clip.dims()?;
    let numbers = |x: &Tensor| x.to_device(&Device::Cpu)?.flatten_all()?.to_vec1::<f32>();
    let (ks, poses) = (numbers(&clip.intrinsics)?, numbers(&clip.world_from_camera)?);
    let view = |(k, m): (&[f32], &[f32])| {
        let column = |c: usize| Vec3A::new(m[c], m[4 + c], m[8 + c]);
        let pose = Affine3A { matrix3: Mat3A::from_cols(column(0), column(1), column(2)), translation: column(3) };
        View::from_pose(pose, Intrinsics { fx: k[0], fy: k[4], cx: k[2], cy: k[5], width, height })
    };
    Ok(ks.chunks_exact(9).zip(poses.chunks_exact(16)).map(view).collect())
}
