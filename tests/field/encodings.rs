//! What an encoding of a raw image says: order of colours, sample size, byte order, padding, planes, mosaics.

use storm_node::msg::Image;

use super::recording::{IMAGE, Recording, pixels};
use super::run::{Ran, replay};

/// The control drive in another encoding: `bytes` per pixel, made of its colours.
fn stored_as(encoding: &str, bytes: u32, with: impl Fn([u8; 3]) -> Vec<u8>) -> Recording {
    Recording::control().images(IMAGE, |m| {
        m.data = pixels(m).flat_map(&with).collect();
        (m.encoding, m.step) = (encoding.to_owned(), m.width * bytes);
    })
}

/// Rows with `bytes` of padding at the end of each.
fn padded(m: &mut Image, bytes: usize) {
    let row = m.step as usize;
    m.data = m.data.chunks(row).flat_map(|r| [r, &vec![9; bytes]].concat()).collect();
    m.step += bytes as u32;
}

/// 16-bit samples, the upper byte last or first, the lower one noise.
fn wide(samples: &[u8], big_endian: bool) -> Vec<u8> {
    samples.iter().flat_map(|v| if big_endian { [*v, 77] } else { [77, *v] }).collect()
}

#[test]
fn bgra8_with_padding() {
    let r = stored_as("bgra8", 4, |[r, g, b]| vec![b, g, r, 200]).images(IMAGE, |m| padded(m, 20));
    replay(r, &[]).like_control(0.0);
}

#[test]
fn rgba16_and_bgr16_in_both_byte_orders() {
    replay(stored_as("rgba16", 8, |[r, g, b]| wide(&[r, g, b, 9], false)), &[]).like_control(0.0);
    let big = stored_as("bgr16", 6, |[r, g, b]| wide(&[b, g, r], true));
    let big = big.images(IMAGE, |m| {
        m.is_bigendian = true;
        padded(m, 6);
    });
    replay(big, &[]).like_control(0.0);
}

#[test]
fn grey_in_8_and_16_bits_is_the_same() {
    let eight = replay(stored_as("mono8", 1, |[_, g, _]| vec![g]), &[]);
    let sixteen = replay(stored_as("mono16", 2, |[_, g, _]| wide(&[g], false)), &[]);
    sixteen.like(&eight, 0.0);
}

/// ITU-R BT.601, video range.
fn yuv([r, g, b]: [u8; 3]) -> [f32; 3] {
    let [r, g, b] = [r, g, b].map(f32::from);
    [
        16.0 + 0.25679 * r + 0.50413 * g + 0.09791 * b,
        128.0 - 0.14822 * r - 0.29099 * g + 0.43922 * b,
        128.0 + 0.43922 * r - 0.36779 * g - 0.07143 * b,
    ]
}

/// Planes of an even-sized image; chroma is the mean over `spacing` pixels along each side.
fn planar(m: &mut Image, encoding: &str, spacing: usize) {
    let (width, height) = (m.width as usize, m.height as usize);
    let all: Vec<[f32; 3]> = pixels(m).map(yuv).collect();
    let mean = |row: usize, col: usize, channel: usize| {
        let block = (0..spacing * spacing).map(|i| all[(row + i / spacing) * width + col + i % spacing][channel]);
        (block.sum::<f32>() / (spacing * spacing) as f32).round() as u8
    };
    let places: Vec<(usize, usize)> =
        (0..height / spacing).flat_map(|r| (0..width / spacing).map(move |c| (r * spacing, c * spacing))).collect();
    let plane = |channel| places.iter().map(|&(r, c)| mean(r, c, channel)).collect::<Vec<u8>>();
    let (u, v) = (plane(1), plane(2));
    let mixed = |a: &[u8], b: &[u8]| a.iter().zip(b).flat_map(|(a, b)| [*a, *b]).collect::<Vec<u8>>();
    let chroma = match encoding {
        "nv12" | "nv24" => mixed(&u, &v),
        "nv21" => mixed(&v, &u),
        "i420" => [u, v].concat(),
        _ => [v, u].concat(),
    };
    m.data = all.iter().map(|p| p[0].round() as u8).collect();
    m.data.extend(chroma);
    m.encoding = encoding.to_owned();
    // The writer wants data of height * step bytes; readers must not rely on what the step claims.
    m.step = (m.data.len() / height) as u32;
}

#[test]
fn luma_and_chroma_in_planes() {
    let run =
        |encoding: &str, spacing| replay(Recording::control().images(IMAGE, |m| planar(m, encoding, spacing)), &[]);
    let nv12 = run("nv12", 2);
    // Chroma has a quarter of the samples.
    nv12.like_control(0.6);
    for encoding in ["nv21", "i420", "yv12"] {
        run(encoding, 2).like(&nv12, 0.0);
    }
    run("nv24", 1).like_control(0.2);
}

#[test]
fn planes_that_do_not_fit_are_refused() {
    let r = Recording::control().images(IMAGE, |m| {
        planar(m, "nv12", 2);
        m.height -= 1;
        m.data.truncate((m.step * m.height) as usize);
    });
    replay(r, &[]).refused(&[IMAGE, "72x47", "`nv12`", "without padding"]);
}

/// The mosaic of RGGB, or of another order of its rows and columns.
pub fn mosaic(m: &mut Image, order: &str) {
    let (width, letters) = (m.width as usize, order.as_bytes());
    let sample = |(i, p): (usize, [u8; 3])| match letters[(i / width % 2) * 2 + i % width % 2] {
        b'r' => p[0],
        b'g' => p[1],
        _ => p[2],
    };
    m.data = pixels(m).enumerate().map(sample).collect();
    (m.encoding, m.step) = (format!("bayer_{order}8"), m.width);
}

/// The control drive through a mosaic of 8 bits.
pub fn bayer(order: &'static str) -> Recording {
    Recording::control().images(IMAGE, |m| mosaic(m, order))
}

#[test]
fn mosaics_of_all_orders_in_8_and_16_bits() {
    let run_wide = |order: &'static str, big: bool| -> Ran {
        let r = bayer(order).images(IMAGE, |m| {
            m.data = wide(&m.data, big);
            (m.encoding, m.step, m.is_bigendian) = (format!("bayer_{order}16"), m.width * 2, big);
            padded(m, 4);
        });
        replay(r, &[])
    };
    for (order, big) in [("rggb", false), ("grbg", true), ("gbrg", false), ("bggr", true)] {
        let eight = replay(bayer(order), &[]);
        // Colour is interpolated: of a picture this small that costs detail.
        eight.like_control(2.0);
        // Means are rounded with the lower bytes in them.
        run_wide(order, big).like(&eight, 0.05);
    }
}

#[test]
fn a_step_too_small_is_refused() {
    // Step and number of bytes stand one after the other; the encoder itself would not write this.
    let sound = [216u32.to_le_bytes(), (216u32 * 48).to_le_bytes()].concat();
    let r = Recording::control().each(IMAGE, |mut m| {
        let at = m.data.windows(8).position(|w| w == sound).unwrap();
        m.data[at] = 215;
        vec![m]
    });
    replay(r, &[]).refused(&[IMAGE, "step 215", "216 bytes"]);
}

#[test]
fn an_unknown_encoding_is_refused_at_once() {
    let r = Recording::control().images(IMAGE, |m| m.encoding = "nv99".into());
    replay(r, &[]).refused(&[IMAGE, "`nv99`", "rgb8", "bayer"]);
}
