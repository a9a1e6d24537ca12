//! Values in another order, and the Gaussian head's: kernels where they cover the tensors, else candle's own operations.

use candle_core::{Result, Tensor};

use super::graph::{Backward, node};
use super::process::zeros;
use crate::kernels::arrange::Nesting;
use crate::kernels::gaussians::{Input, Meaning, Output};
use crate::kernels::tensors::{covered, tracked, with_all, with_values};
use crate::kernels::{self, Isa};

fn ready<'a>(tensors: impl IntoIterator<Item = &'a Tensor> + Clone) -> bool {
    covered(tensors.clone()) && !tracked(tensors.clone()) && tensors.into_iter().all(|t| t.elem_count() > 0)
}

/// Pictures `(views, 3, h, w)` and ray planes `(views, c, h, w)` to patches `(views rows cols, (3 + c) p p)`.
pub(crate) fn patches(image: &Tensor, planes: &Tensor, p: usize) -> Result<Tensor> {
    let (views, a, h, w) = image.dims4()?;
    let (_, b, _, _) = planes.dims4()?;
    let (rows, cols, channels) = (h / p, w / p, a + b);
    if planes.dims() != [views, b, h, w] || rows * p != h || cols * p != w {
        candle_core::bail!("patches of {p}: picture {:?}, planes {:?}", image.dims(), planes.dims());
    }
    let shape = (views * rows * cols, channels * p * p);
    if !ready([image, planes]) {
        return Tensor::cat(&[image, planes], 1)?
            .reshape(vec![views, channels, rows, p, cols, p])?
            .permute(vec![0, 2, 4, 1, 3, 5])?
            .contiguous()?
            .reshape(shape);
    }
    let mut out = zeros(shape.0 * shape.1);
    with_all([image, planes], |[image, planes]| {
        kernels::arrange::patches(&[(image, a), (planes, b)], [views, h, w], p, &mut out);
        Ok(())
    })?;
    Tensor::from_vec(out, shape, image.device())
}

/// `(n rows cols 4^levels, c)`, each of the `n` images in nested order, to
/// `(n, rows 2^levels copies, cols 2^levels copies, c)`.
pub(crate) fn unnest(x: &Tensor, nesting: Nesting) -> Result<Tensor> {
    let (all, c) = x.dims2()?;
    let Nesting { grid, levels, copies } = nesting;
    let (height, width) = (grid.0 << levels, grid.1 << levels);
    let pixels = height * width;
    if pixels == 0 || copies == 0 || !all.is_multiple_of(pixels) {
        candle_core::bail!("{all} nested pixels do not fill images of {nesting:?}");
    }
    let images = all / pixels;
    if !covered([x]) || all == 0 {
        let x = in_rows(x, grid, levels)?;
        return match copies {
            1 => Ok(x),
            _ => x
                .reshape((images, height, 1, width, 1, c))?
                .broadcast_as((images, height, copies, width, copies, c))?
                .contiguous()?
                .reshape((images, height * copies, width * copies, c)),
        };
    }
    let mut out = zeros(x.elem_count() * copies * copies);
    with_values(x, |x| {
        kernels::arrange::unnest(x, c, nesting, &mut out);
        Ok(())
    })?;
    let backward = UnnestBackward { nesting, all, c };
    node(out, (images, height * copies, width * copies, c), &[Some(x)], backward)
}

struct UnnestBackward {
    nesting: Nesting,
    all: usize,
    c: usize,
}

impl Backward for UnnestBackward {
    fn name(&self) -> &'static str {
        "unnest"
    }

    fn gradients(&self, _: &Tensor, grad: &Tensor) -> Result<Vec<Option<Tensor>>> {
        let mut out = zeros(self.all * self.c);
        with_values(grad, |grad| {
            kernels::arrange::nest(grad, self.c, self.nesting, &mut out);
            Ok(())
        })?;
        Ok(vec![Some(Tensor::from_vec(out, (self.all, self.c), grad.device())?)])
    }
}

/// [`unnest`] without copies, by candle's own operations.
fn in_rows(x: &Tensor, grid: (usize, usize), levels: usize) -> Result<Tensor> {
    let (all, c) = x.dims2()?;
    let side = 1 << levels;
    let images = all / (grid.0 * grid.1 * side * side).max(1);
    // candle goes through no more than 8 axes that do not lie one in the other: more levels are taken one by one.
    if levels > 3 {
        let ((rows, cols), inner) = (grid, 1 << (2 * (levels - 1)));
        let x = x.reshape((images, rows, cols, 2, 2, inner * c))?.permute((0, 1, 3, 2, 4, 5))?.contiguous()?;
        return in_rows(&x.reshape((all, c))?, (2 * rows, 2 * cols), levels - 1);
    }
    let mut shape = vec![images, grid.0, grid.1];
    shape.extend(std::iter::repeat_n(2, 2 * levels));
    shape.push(c);
    // Axes: image, row, col, then (row bit, col bit) per level, coarse to fine.
    let rows = std::iter::once(1).chain((0..levels).map(|k| 3 + 2 * k));
    let cols = std::iter::once(2).chain((0..levels).map(|k| 4 + 2 * k));
    let axes: Vec<usize> = std::iter::once(0).chain(rows).chain(cols).chain(std::iter::once(3 + 2 * levels)).collect();
    x.reshape(shape)?.permute(axes)?.contiguous()?.reshape((images, grid.0 * side, grid.1 * side, c))
}

/// Means, scales, quaternions, opacities, colours and depths of the Gaussian head's raw numbers, each `(views h w, channels)`
/// flat; none where the kernel does not cover the tensors.
pub(crate) fn gaussians(
    meaning: &Meaning,
    [raw, image, origins, directions]: [&Tensor; 4],
    dims: [usize; 3],
) -> Result<Option<[Vec<f32>; 6]>> {
    if !ready([raw, image, origins, directions]) {
        return Ok(None);
    }
    let pixels: usize = dims.iter().product();
    let mut out = [3, 3, 4, 1, 3, 1].map(|channels| zeros(channels * pixels));
    let [means, scales, quats, opacities, colors, depths] = &mut out;
    with_all([raw, image, origins, directions], |[raw, image, origins, directions]| {
        let input = Input { raw, image, origins, directions, dims };
        kernels::gaussians::gaussians(
            Isa::detect(),
            meaning,
            &input,
            Output { means, scales, quats, opacities, colors, depths },
        );
        Ok(())
    })?;
    Ok(Some(out))
}
