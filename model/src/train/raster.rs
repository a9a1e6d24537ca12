//! The rasteriser as an operation that candle can differentiate.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use candle_core::{CpuStorage, CustomOp1, Device, Layout, Result, Shape, Tensor};
use storm_render::View;
use storm_render::raster::{CpuRasterizer, Picture, PictureGradient, SplatGradients, Splats};

/// Numbers of a packed Gaussian: mean 3, quaternion 4, scale 3, opacity 1, colour 3.
pub(super) const PACKED: usize = 14;

/// Colour channels drawn.
const COLORS: usize = 3;

/// Channels of a drawn pixel: colour, opacity, depth.
pub(super) const DRAWN: usize = COLORS + 2;

/// Something that draws Gaussians and knows the gradient of what it drew.
pub trait SceneGradient: Send {
    /// Draws every view.
    fn draw(&mut self, splats: &Splats<'_>, views: &[View]) -> std::result::Result<Vec<Picture>, String>;

    /// Gradients with respect to the Gaussians of the last [`draw`](Self::draw) (of these very arguments), from those with
    /// respect to its pictures.
    fn gradient(
        &mut self,
        splats: &Splats<'_>,
        views: &[View],
        pictures: &[Picture],
        upstream: &[PictureGradient],
    ) -> std::result::Result<SplatGradients, String>;
}

impl SceneGradient for CpuRasterizer {
    fn draw(&mut self, splats: &Splats<'_>, views: &[View]) -> std::result::Result<Vec<Picture>, String> {
        self.render(splats, views).map_err(|e| e.to_string())
    }

    fn gradient(
        &mut self,
        splats: &Splats<'_>,
        views: &[View],
        pictures: &[Picture],
        upstream: &[PictureGradient],
    ) -> std::result::Result<SplatGradients, String> {
        self.backward(splats, views, pictures, upstream).map_err(|e| e.to_string())
    }
}

/// A renderer shared by all drawing operations of a step.
pub type SharedRenderer = Arc<Mutex<dyn SceneGradient>>;

/// Draws packed Gaussians `(n, 14)` into `views` (all of one size): `(views, h, w, 5)`, colour, opacity and expected
/// z-depth (metres). Computed on the CPU wherever the tensor lies.
pub(super) fn draw(packed: &Tensor, views: Vec<View>, renderer: &SharedRenderer) -> Result<Tensor> {
    let (_, PACKED) = packed.dims2()? else {
        candle_core::bail!("packed Gaussians have shape {:?}, expected (n, {PACKED})", packed.dims());
    };
    let Some(first) = views.first().map(|v| [v.intrinsics.height, v.intrinsics.width]) else {
        candle_core::bail!("no views to draw");
    };
    if views.iter().any(|v| [v.intrinsics.height, v.intrinsics.width] != first) {
        candle_core::bail!("views of one drawing differ in size");
    }
    let device = packed.device();
    let drawn =
        packed.to_device(&Device::Cpu)?.contiguous()?.apply_op1(Draw { views, renderer: Arc::clone(renderer) })?;
    drawn.to_device(device)
}

struct Draw {
    views: Vec<View>,
    renderer: SharedRenderer,
}

/// Packed rows as the rasteriser takes them.
struct Unpacked {
    means: Vec<[f32; 3]>,
    quats: Vec<[f32; 4]>,
    scales: Vec<[f32; 3]>,
    opacities: Vec<f32>,
    colors: Vec<f32>,
}

impl Unpacked {
    fn new(packed: &[f32]) -> Self {
        let rows = || packed.chunks_exact(PACKED);
        let three = |r: &[f32], at: usize| [r[at], r[at + 1], r[at + 2]];
        Self {
            means: rows().map(|r| three(r, 0)).collect(),
            quats: rows().map(|r| [r[3], r[4], r[5], r[6]]).collect(),
            scales: rows().map(|r| three(r, 7)).collect(),
            opacities: rows().map(|r| r[10]).collect(),
            colors: rows().flat_map(|r| three(r, 11)).collect(),
        }
    }

    fn splats(&self) -> Splats<'_> {
        Splats {
            means: &self.means,
            quats: &self.quats,
            scales: &self.scales,
            opacities: &self.opacities,
            features: &self.colors,
            feature_count: COLORS,
        }
    }
}

fn failed(reason: String) -> candle_core::Error {
    candle_core::Error::Msg(format!("drawing: {reason}"))
}

impl Draw {
    fn renderer(&self) -> MutexGuard<'_, dyn SceneGradient + 'static> {
        // Its buffers are refilled by every drawing, so a panic elsewhere leaves nothing broken behind.
        self.renderer.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl CustomOp1 for Draw {
    fn name(&self) -> &'static str {
        "draw"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let Some((start, end)) = layout.contiguous_offsets() else {
            candle_core::bail!("packed Gaussians are not contiguous");
        };
        let unpacked = Unpacked::new(&storage.as_slice::<f32>()?[start..end]);
        let pictures = self.renderer().draw(&unpacked.splats(), &self.views).map_err(failed)?;
        let (h, w) = pictures.first().map_or((0, 0), |p| (p.height, p.width));
        let mut out = Vec::with_capacity(pictures.len() * h * w * DRAWN);
        for picture in &pictures {
            for (i, color) in picture.features.chunks_exact(COLORS).enumerate() {
                out.extend_from_slice(color);
                out.extend([picture.alpha[i], picture.depth[i]]);
            }
        }
        Ok((CpuStorage::F32(out), Shape::from((pictures.len(), h, w, DRAWN))))
    }

    fn bwd(&self, arg: &Tensor, _res: &Tensor, grad_res: &Tensor) -> Result<Option<Tensor>> {
        let unpacked = Unpacked::new(&arg.flatten_all()?.to_vec1::<f32>()?);
        let upstream = grad_res.flatten_all()?.to_vec1::<f32>()?;
        let per_view = upstream.len() / self.views.len().max(1);
        let gradients: Vec<PictureGradient> = upstream
            .chunks_exact(per_view.max(1))
            .map(|view| PictureGradient {
                features: view.chunks_exact(DRAWN).flat_map(|p| [p[0], p[1], p[2]]).collect(),
                alpha: view.iter().skip(COLORS).step_by(DRAWN).copied().collect(),
                depth: view.iter().skip(COLORS + 1).step_by(DRAWN).copied().collect(),
            })
            .collect();
        let mut renderer = self.renderer();
        // Other drawings came between: draw again rather than keep the tile lists of every drawing of a step.
        let pictures = renderer.draw(&unpacked.splats(), &self.views).map_err(failed)?;
        let g = renderer.gradient(&unpacked.splats(), &self.views, &pictures, &gradients).map_err(failed)?;
        drop(renderer);
        let mut out = Vec::with_capacity(unpacked.means.len() * PACKED);
        for i in 0..unpacked.means.len() {
            out.extend(g.means[i]);
            out.extend(g.quats[i]);
            out.extend(g.scales[i]);
            out.push(g.opacities[i]);
            out.extend_from_slice(&g.features[COLORS * i..COLORS * (i + 1)]);
        }
        Ok(Some(Tensor::from_vec(out, arg.shape(), arg.device())?))
    }
}
