//! Colour maps by formula.

use super::Rgb;

/// A rainbow from blue over green to red, close to the published "turbo" map: one polynomial of degree 7 per channel,
/// fitted by least squares, lowest power first.
const TURBO: [[f32; 8]; 3] = [
    [0.1627, 2.1544, -0.1206, -143.9975, 693.5088, -1262.8563, 1017.8448, -306.2687],
    [0.0769, 2.7030, 1.1729, -9.0313, 24.8927, -68.3462, 76.6028, -28.0518],
    [0.2727, 4.5173, 32.8998, -332.6122, 953.5599, -1264.3608, 803.7684, -198.0095],
];

/// Colour of `x` from 0 (blue) to 1 (red); clamped, NaN as 0.
pub fn turbo(x: f32) -> Rgb {
    let x = if x > 0.0 { x.min(1.0) } else { 0.0 };
    TURBO.map(|c| {
        let y = c.iter().rev().fold(0.0, |sum, &k| sum * x + k);
        (y.clamp(0.0, 1.0) * 255.0).round() as u8
    })
}

/// Hue (turns, any number), saturation and value (0 to 1) to RGB.
pub fn hsv(hue_turns: f32, saturation: f32, value: f32) -> Rgb {
    let h = hue_turns.rem_euclid(1.0) * 6.0;
    // Each channel falls off with its distance on the wheel from its own hue: red 0, green 2, blue 4 of 6.
    [0.0, 2.0, 4.0].map(|center: f32| {
        let d = (h - center).abs();
        let pure = (2.0 - d.min(6.0 - d)).clamp(0.0, 1.0);
        let c = value.clamp(0.0, 1.0) * (1.0 - saturation.clamp(0.0, 1.0) * (1.0 - pure));
        (c * 255.0).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turbo_goes_from_blue_over_green_to_red() {
        let [r, g, b] = turbo(0.15);
        assert!(b > g && b > r);
        let [r, g, b] = turbo(0.45);
        assert!(g > r && g > b);
        let [r, g, b] = turbo(0.92);
        assert!(r > g && r > b);
        assert_eq!(turbo(f32::NAN), turbo(-3.0));
        assert_eq!(turbo(9.0), turbo(1.0));
    }

    #[test]
    fn the_hue_wheel_has_its_corners() {
        assert_eq!(hsv(0.0, 1.0, 1.0), [255, 0, 0]);
        assert_eq!(hsv(1.0 / 6.0, 1.0, 1.0), [255, 255, 0]);
        assert_eq!(hsv(1.0 / 3.0, 1.0, 1.0), [0, 255, 0]);
        assert_eq!(hsv(-1.0 / 3.0, 1.0, 1.0), [0, 0, 255]);
        assert_eq!(hsv(0.3, 0.0, 0.5), [128, 128, 128]);
    }
}
