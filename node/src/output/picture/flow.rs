//! Scene flow in colour: direction in the ground plane as hue, speed as saturation and brightness, still things
//! dark grey.

use super::draw::{text_height, text_width};
use super::{OutputError, Picture, Rgb, STRIP, STRIP_TEXT, hsv};

/// Colour of pixels without a surface (the sky).
const NO_FLOW: Rgb = [26, 28, 36];
/// Brightness of what stands still.
const STILL_VALUE: f32 = 0.32;

/// Colour of a velocity (m/s; x and y span the ground plane). `full_mps` is the speed of full saturation.
pub fn flow_color(velocity_mps: [f32; 3], full_mps: f32) -> Rgb {
    let [vx, vy, vz] = velocity_mps;
    let speed = (vx * vx + vy * vy + vz * vz).sqrt();
    if !speed.is_finite() {
        return NO_FLOW;
    }
    // The square root lifts slow motion, which is what one looks for, out of the grey.
    let strength = if full_mps > 0.0 { (speed / full_mps).min(1.0).sqrt() } else { 0.0 };
    hsv(vy.atan2(vx) / std::f32::consts::TAU, strength, STILL_VALUE + (1.0 - STILL_VALUE) * strength)
}

/// Flow in colour, row-major, m/s in axes whose x and y span the ground plane; `valid` false is drawn dark.
pub fn flow_picture(
    width: usize,
    height: usize,
    flow_mps: &[[f32; 3]],
    valid: Option<&[bool]>,
    full_mps: f32,
) -> Result<Picture, OutputError> {
    let expected = width.saturating_mul(height);
    let lengths = [("flow", flow_mps.len()), ("valid", valid.map_or(expected, <[bool]>::len))];
    if let Some((what, got)) = lengths.into_iter().find(|&(_, got)| got != expected) {
        return Err(OutputError::Length { what, expected, got });
    }
    Ok(Picture::from_fn(width, height, |col, row| {
        let i = row * width + col;
        if valid.is_none_or(|v| v[i]) { flow_color(flow_mps[i], full_mps) } else { NO_FLOW }
    }))
}

/// The legend: a wheel seen from above, x to the right and y up, `full_mps` at its rim; the colour of a legend strip outside.
pub fn flow_wheel(diameter: usize, full_mps: f32) -> Picture {
    let radius = 0.5 * diameter as f32;
    Picture::from_fn(diameter, diameter, |col, row| {
        let (x, y) = ((col as f32 + 0.5 - radius) / radius, (radius - row as f32 - 0.5) / radius);
        if x.hypot(y) <= 1.0 { flow_color([x * full_mps, y * full_mps, 0.0], full_mps) } else { STRIP }
    })
}

/// The picture with a strip below: the wheel and the speed at its rim.
pub fn with_flow_wheel(picture: &Picture, full_mps: f32) -> Picture {
    let text_scale = if picture.width() >= 480 { 2 } else { 1 };
    let wheel = flow_wheel(16 * text_scale, full_mps);
    let mut out = Picture::filled(picture.width(), picture.height() + wheel.height(), STRIP);
    out.blit(picture, 0, 0);
    out.blit(&wheel, 0, picture.height());
    let label = if full_mps >= 1.0 { format!("{full_mps:.0} m/s") } else { format!("{full_mps:.2} m/s") };
    let row = picture.height() + (wheel.height() - text_height(text_scale)) / 2;
    if wheel.width() + 4 * text_scale + text_width(&label, text_scale) <= out.width() {
        out.text(&label, wheel.width() + 4 * text_scale, row, text_scale, STRIP_TEXT);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn direction_is_hue_and_speed_is_saturation() {
        let spread = |c: Rgb| c.iter().max().unwrap() - c.iter().min().unwrap();
        let still = flow_color([0.0; 3], 10.0);
        assert_eq!(spread(still), 0);
        let [slow, fast] = [flow_color([1.0, 0.0, 0.0], 10.0), flow_color([10.0, 0.0, 0.0], 10.0)];
        assert!(spread(slow) > 30 && spread(fast) > spread(slow));
        assert!(fast[0] > fast[1] && fast[1] == fast[2], "forward is red: {fast:?}");
        assert_ne!(flow_color([0.0, 10.0, 0.0], 10.0), flow_color([0.0, -10.0, 0.0], 10.0));
        assert_eq!(flow_color([f32::NAN, 0.0, 0.0], 10.0), NO_FLOW);
    }

    #[test]
    fn the_wheel_agrees_with_the_picture() {
        let wheel = flow_wheel(101, 8.0);
        assert_eq!(wheel.get(0, 0), Some(STRIP));
        let right = wheel.get(100, 50).unwrap();
        assert!(right[0] > right[1]);
        let p = flow_picture(2, 1, &[[0.0, 8.0, 0.0], [8.0, 0.0, 0.0]], Some(&[true, false]), 8.0).unwrap();
        let (top, shown) = (wheel.get(50, 0).unwrap(), p.get(0, 0).unwrap());
        assert!((0..3).all(|k| top[k].abs_diff(shown[k]) < 5), "{top:?} {shown:?}");
        assert_eq!(p.get(1, 0), Some(NO_FLOW));
        assert!(flow_picture(2, 1, &[[0.0; 3]; 2], Some(&[true]), 8.0).is_err());
        assert_eq!(with_flow_wheel(&p, 8.0).height(), 17);
    }
}
