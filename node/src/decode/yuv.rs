//! YUV encodings: two pixels in four bytes, or planes.

use super::encoding::Planes;
use super::error::DecodeError;
use super::rows::{layout_error, rows, step};
use crate::msg::Image;

/// 4:2:2 in groups of four bytes; `places` are those of both lumas, of U and of V. Two pixels share a chroma sample; the last
/// pixel of an odd width uses its own pair's. RGB, `height * width * 3`.
pub fn pairs(image: &Image, places: [usize; 4]) -> Result<Vec<u8>, DecodeError> {
    let [first, second, u, v] = places.map(|p| p % 4);
    let width = image.width as usize;
    let rows = rows(image, width.div_ceil(2) * 4)?;
    let mut out = Vec::with_capacity(width * image.height as usize * 3);
    for row in rows {
        let (pairs, _) = row.as_chunks::<4>();
        for (i, pair) in pairs.iter().enumerate() {
            out.extend(bt601(pair[first], pair[u], pair[v]));
            if 2 * i + 1 < width {
                out.extend(bt601(pair[second], pair[u], pair[v]));
            }
        }
    }
    Ok(out)
}

/// A plane of luma and chroma behind it; the image's height is that of the luma. RGB, `height * width * 3`.
///
/// The step is the luma's, and chroma rows are as long in proportion. Where the data are as many as there are without any
/// padding, they are read so, whatever the step claims: some drivers give there what one row of all planes takes.
pub fn planes(image: &Image, planes: Planes) -> Result<Vec<u8>, DecodeError> {
    let (width, height) = (image.width as usize, image.height as usize);
    let mut layout = Layout::new(step(image, width)?, height, planes);
    let there = image.data.len();
    if layout.bytes() > there {
        let tight = Layout::new(width, height, planes);
        if tight.bytes() != there {
            let why = format!("luma and chroma take {} bytes, {} without padding", layout.bytes(), tight.bytes());
            return Err(layout_error(image, why));
        }
        layout = tight;
    }
    let mut out = Vec::with_capacity(width * height * 3);
    for row in 0..height {
        let luma = layout.luma(&image.data, row, width);
        for (col, y) in luma.iter().enumerate() {
            let [u, v] = layout.chroma(row, col).map(|at| image.data.get(at).copied().unwrap_or(128));
            out.extend(bt601(*y, u, v));
        }
    }
    Ok(out)
}

/// Where the samples of a picture in planes lie.
struct Layout {
    /// Bytes from one luma row to the next.
    step: usize,
    /// Bytes from one chroma row to the next.
    chroma_step: usize,
    /// Luma rows.
    height: usize,
    /// Rows of one chroma plane.
    chroma_height: usize,
    planes: Planes,
}

impl Layout {
    fn new(step: usize, height: usize, planes: Planes) -> Self {
        let samples = step.div_ceil(planes.spacing);
        let chroma_step = if planes.interleaved { 2 * samples } else { samples };
        Self { step, chroma_step, height, chroma_height: height.div_ceil(planes.spacing), planes }
    }

    /// Bytes of all planes.
    fn bytes(&self) -> usize {
        let planes = if self.planes.interleaved { 1 } else { 2 };
        self.step * self.height + self.chroma_step * self.chroma_height * planes
    }

    fn luma<'a>(&self, data: &'a [u8], row: usize, width: usize) -> &'a [u8] {
        data.get(row * self.step..row * self.step + width).unwrap_or(&[])
    }

    /// Places of U and V of a pixel.
    fn chroma(&self, row: usize, col: usize) -> [usize; 2] {
        let Planes { spacing, interleaved, v_first } = self.planes;
        let row_start = self.step * self.height + row / spacing * self.chroma_step;
        let (first, second) = if interleaved {
            let at = row_start + col / spacing * 2;
            (at, at + 1)
        } else {
            let at = row_start + col / spacing;
            (at, at + self.chroma_step * self.chroma_height)
        };
        if v_first { [second, first] } else { [first, second] }
    }
}

/// ITU-R BT.601, video range (16-235), in 20-bit fixed point.
fn bt601(y: u8, u: u8, v: u8) -> [u8; 3] {
    const BITS: u32 = 20;
    const HALF: i32 = 1 << (BITS - 1);
    // 255/219, and the BT.601 matrix for (Kr, Kb) = (0.299, 0.114) scaled by 255/224.
    const Y: i32 = 1_220_945;
    const RV: i32 = 1_673_555;
    const GU: i32 = -410_793;
    const GV: i32 = -852_458;
    const BU: i32 = 2_115_221;
    let y = (i32::from(y) - 16).max(0) * Y;
    let (u, v) = (i32::from(u) - 128, i32::from(v) - 128);
    let clamp = |x: i32| ((y + x + HALF) >> BITS).clamp(0, 255) as u8;
    [clamp(RV * v), clamp(GU * u + GV * v), clamp(BU * u)]
}

#[cfg(test)]
mod tests {
    use super::super::image_to_rgb;
    use super::*;
    use proptest::prelude::*;

    fn image(encoding: &str, width: u32, height: u32, step: u32, data: &[u8]) -> Image {
        Image { encoding: encoding.to_owned(), width, height, step, data: data.to_vec(), ..Image::default() }
    }

    #[test]
    fn yuv_of_known_colours() {
        // Video-range BT.601: white (235,128,128), black (16,128,128), red (81,90,240), blue (41,240,110).
        let uyvy = [128, 235, 128, 16];
        assert_eq!(image_to_rgb(&image("yuv422", 2, 1, 4, &uyvy)).unwrap().data, [255, 255, 255, 0, 0, 0]);
        let yuyv = [81, 90, 81, 240];
        for (got, want) in
            image_to_rgb(&image("yuv422_yuy2", 2, 1, 4, &yuyv)).unwrap().data.iter().zip([254, 0, 0].iter().cycle())
        {
            assert!(got.abs_diff(*want) <= 1, "{got} {want}");
        }
        let blue = image_to_rgb(&image("uyvy", 1, 1, 4, &[240, 41, 110, 0])).unwrap().data;
        assert!(blue[0] == 0 && blue[1] == 0 && blue[2] >= 254, "{blue:?}");
        // The video-range matrix in floating point, over a grid.
        for (y, u, v) in [(60u8, 100u8, 180u8), (200, 30, 77), (128, 128, 128), (17, 255, 0)] {
            let (fy, fu, fv) = (1.164_383_6 * (f64::from(y) - 16.0), f64::from(u) - 128.0, f64::from(v) - 128.0);
            let want = [fy + 1.596_026_8 * fv, fy - 0.391_762_3 * fu - 0.812_967_6 * fv, fy + 2.017_232_1 * fu];
            for (got, want) in bt601(y, u, v).iter().zip(want) {
                assert!((f64::from(*got) - want.clamp(0.0, 255.0)).abs() <= 0.5 + 1e-3, "{y} {u} {v}: {got} {want}");
            }
        }
    }

    /// Luma and chroma of a pixel; chroma is the same over blocks of two by two.
    fn pixel(row: usize, col: usize) -> [u8; 3] {
        let (r, c) = (row / 2, col / 2);
        [(40 + 17 * row + 9 * col) as u8, (100 + 13 * r + 5 * c) as u8, (140 + 3 * r + 21 * c) as u8]
    }

    fn write(encoding: &str, width: usize, height: usize, pad: usize) -> Vec<u8> {
        let spacing = if encoding == "nv24" { 1 } else { 2 };
        let step = width + pad;
        let mut data = Vec::new();
        for row in 0..height {
            data.extend((0..step).map(|col| if col < width { pixel(row, col)[0] } else { 7 }));
        }
        let samples = step.div_ceil(spacing);
        let chroma = |which: &[usize], data: &mut Vec<u8>| {
            for row in 0..height.div_ceil(spacing) {
                for col in 0..samples {
                    data.extend(which.iter().map(|&w| pixel(row * spacing, col * spacing)[w]));
                }
            }
        };
        match encoding {
            "nv12" | "nv24" => chroma(&[1, 2], &mut data),
            "nv21" => chroma(&[2, 1], &mut data),
            "i420" => {
                chroma(&[1], &mut data);
                chroma(&[2], &mut data);
            }
            _ => {
                chroma(&[2], &mut data);
                chroma(&[1], &mut data);
            }
        }
        data
    }

    proptest! {
        #[test]
        fn planes_give_every_pixel_its_own_chroma(
            encoding in prop::sample::select(vec!["nv12", "nv21", "nv24", "i420", "yv12"]),
            width in 1usize..9, height in 1usize..7, pad in 0usize..4,
        ) {
            let data = write(encoding, width, height, pad);
            let step = (width + pad) as u32;
            let got = image_to_rgb(&image(encoding, width as u32, height as u32, step, &data)).unwrap().data;
            for (i, rgb) in got.chunks(3).enumerate() {
                let [y, u, v] = pixel(i / width, i % width);
                prop_assert_eq!(rgb, bt601(y, u, v));
            }
            // A step that is shorter than a row.
            let e = image_to_rgb(&image(encoding, width as u32 + 5, height as u32, step, &data));
            prop_assert!(matches!(e, Err(DecodeError::Layout { .. })), "{e:?}");
            // Whatever the step claims, data without padding are read without.
            let data = write(encoding, width, height, 0);
            let claims = (width + width.div_ceil(2)) as u32;
            let tight = image_to_rgb(&image(encoding, width as u32, height as u32, claims, &data)).unwrap().data;
            prop_assert_eq!(tight, got);
            let e = image_to_rgb(&image(encoding, width as u32, height as u32, claims, &data[1..]));
            prop_assert!(matches!(e, Err(DecodeError::Layout { .. })), "{e:?}");
        }
    }
}
