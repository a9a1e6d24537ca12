//! Cars, vans, lorries and buses from tapered boxes and turning wheels.

use super::dice::Dice;
use super::material::{Material, Surface, rgb};
use super::part::{Joint, PartSpec};
use super::shapes::Shape;
use glam::{Mat3, Vec2, Vec3};

/// Body style.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Build {
    Saloon,
    Hatchback,
    Suv,
    Van,
    Lorry,
    Bus,
}

/// One vehicle's looks; its frame sits on the ground under the rear axle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct VehicleModel {
    pub build: Build,
    pub length: f32,
    pub width: f32,
    pub height: f32,
    pub wheelbase: f32,
    /// Rear axle to rear end.
    pub overhang: f32,
    pub wheel: f32,
    paint: Vec3,
    seed: u64,
}

const DARK: Vec3 = Vec3::new(0.012, 0.012, 0.014);

fn paint(dice: &mut Dice) -> Vec3 {
    let base = dice.pick(&[
        rgb(235, 235, 235),
        rgb(225, 226, 228),
        rgb(165, 168, 172),
        rgb(120, 124, 130),
        rgb(60, 62, 66),
        rgb(25, 26, 30),
        rgb(20, 20, 22),
        rgb(30, 55, 120),
        rgb(60, 95, 150),
        rgb(150, 25, 25),
        rgb(195, 40, 35),
        rgb(120, 95, 70),
        rgb(200, 190, 165),
        rgb(40, 80, 60),
        rgb(220, 170, 40),
        rgb(225, 115, 40),
    ]);
    base * dice.range32(0.8, 1.15)
}

impl VehicleModel {
    pub(crate) fn roll(dice: &mut Dice, big: f64) -> Self {
        use Build::{Bus, Hatchback, Lorry, Saloon, Suv, Van};
        let build = if dice.chance(big) {
            dice.pick(&[Van, Van, Lorry, Bus])
        } else {
            dice.pick(&[Saloon, Saloon, Hatchback, Suv, Suv])
        };
        let (length, width, height, wheelbase, overhang, wheel) = match build {
            Saloon => (4.6, 1.82, 1.45, 2.75, 0.95, 0.32),
            Hatchback => (4.0, 1.75, 1.5, 2.55, 0.7, 0.31),
            Suv => (4.65, 1.9, 1.72, 2.75, 0.9, 0.37),
            Van => (5.4, 2.0, 2.3, 3.3, 1.05, 0.35),
            Lorry => (8.2, 2.45, 3.3, 4.7, 2.1, 0.48),
            Bus => (11.2, 2.5, 3.05, 5.8, 2.9, 0.48),
        };
        let (a, b) = (dice.range32(0.94, 1.06), dice.range32(0.96, 1.04));
        Self {
            build,
            length: length * a,
            width: width * b,
            height: height * b,
            wheelbase: wheelbase * a,
            overhang: overhang * a,
            wheel,
            paint: paint(dice),
            seed: dice.next(),
        }
    }

    /// From the frame's origin to the middle of the footprint, along x.
    pub(crate) fn middle(&self) -> f32 {
        0.5 * self.length - self.overhang
    }

    /// Adds the parts of a vehicle whose wheels have rolled `rolled` metres and whose speed is `speed`.
    pub(crate) fn parts(&self, rolled: f64, speed: f32, out: &mut Vec<PartSpec>) {
        match self.build {
            Build::Saloon | Build::Hatchback | Build::Suv => self.car(out),
            Build::Van => self.van(out),
            Build::Lorry => self.lorry(out),
            Build::Bus => self.bus(out),
        }
        self.wheels(rolled, speed, out);
    }

    fn body_paint(&self) -> Material {
        let axles = [-self.middle(), self.wheelbase - self.middle()];
        Material::new(Surface::Body { axles, arch: self.wheel * 1.18 }, self.paint).seed(self.seed)
    }

    fn car(&self, out: &mut Vec<PartSpec>) {
        let (l, w, h) = (self.length, self.width, self.height);
        let mid = self.middle();
        let floor = self.wheel * 0.62;
        let belt = h * 0.6;
        let body = Shape::taper(l, w, belt - floor, Vec2::new(l * 0.965, w * 0.95), Vec2::ZERO);
        out.push(PartSpec::fixed(body, Vec3::new(mid, 0.0, 0.5 * (belt + floor)), self.body_paint()));
        // Cabin: length at the belt and at the roof, and how far back it sits.
        let (low, top, back, lean) = match self.build {
            Build::Saloon => (l * 0.62, l * 0.34, -l * 0.06, -l * 0.035),
            Build::Hatchback => (l * 0.72, l * 0.5, -l * 0.12, -l * 0.03),
            _ => (l * 0.72, l * 0.54, -l * 0.12, -l * 0.02),
        };
        let cabin = Shape::taper(low, w * 0.93, h - belt, Vec2::new(top, w * 0.76), Vec2::new(lean, 0.0));
        let glass = Material::new(Surface::Cabin, self.paint).seed(self.seed);
        out.push(PartSpec::fixed(cabin, Vec3::new(mid + back, 0.0, 0.5 * (h + belt)), glass));
        for side in [-1.0, 1.0] {
            let mirror = Vec3::new(mid + back + low * 0.36, side * (w * 0.5 + 0.06), belt + 0.06);
            out.push(PartSpec::fixed(
                Shape::cuboid(0.12, 0.2, 0.14),
                mirror,
                Material::new(Surface::Sheen, self.paint * 0.8),
            ));
        }
    }

    fn van(&self, out: &mut Vec<PartSpec>) {
        let (l, w, h) = (self.length, self.width, self.height);
        let (mid, floor) = (self.middle(), self.wheel * 0.6);
        let nose = l * 0.24;
        let box_length = l - nose;
        let coach = Material::new(Surface::Coach { glass: 1.0, stripe: 0.0 }, self.paint).seed(self.seed);
        let rear = mid - 0.5 * l + 0.5 * box_length;
        out.push(PartSpec::fixed(
            Shape::taper(box_length, w, h - floor, Vec2::new(box_length, w * 0.93), Vec2::ZERO),
            Vec3::new(rear, 0.0, 0.5 * (h + floor)),
            coach,
        ));
        let front = mid + 0.5 * l - 0.5 * nose;
        let belt = h * 0.52;
        let hood =
            Shape::taper(nose, w * 0.99, belt - floor, Vec2::new(nose * 0.9, w * 0.95), Vec2::new(-nose * 0.05, 0.0));
        out.push(PartSpec::fixed(hood, Vec3::new(front, 0.0, 0.5 * (belt + floor)), {
            Material::new(Surface::Body { axles: [9.0, 9.0], arch: 0.0 }, self.paint).seed(self.seed)
        }));
        let glass = Shape::taper(
            nose * 0.9,
            w * 0.93,
            h * 0.44,
            Vec2::new(nose * 0.12, w * 0.85),
            Vec2::new(-nose * 0.39, 0.0),
        );
        let cabin = Material::new(Surface::Cabin, self.paint).seed(self.seed);
        out.push(PartSpec::fixed(glass, Vec3::new(front - nose * 0.05, 0.0, belt + h * 0.22), cabin));
    }

    fn lorry(&self, out: &mut Vec<PartSpec>) {
        let (l, w, h) = (self.length, self.width, self.height);
        let mid = self.middle();
        let cab = 1.9;
        let cab_h = h * 0.82;
        let chassis = Material::new(Surface::Plain, DARK * 3.0);
        out.push(PartSpec::fixed(Shape::cuboid(l * 0.95, w * 0.5, 0.3), Vec3::new(mid, 0.0, 0.75), chassis));
        let front = mid + 0.5 * l - 0.5 * cab;
        let cabin = Material::new(Surface::Coach { glass: 0.55, stripe: 0.0 }, self.paint).seed(self.seed);
        out.push(PartSpec::fixed(
            Shape::taper(cab, w * 0.97, cab_h - 0.45, Vec2::new(cab * 0.9, w * 0.93), Vec2::new(-cab * 0.04, 0.0)),
            Vec3::new(front, 0.0, 0.5 * (cab_h + 0.45)),
            cabin,
        ));
        let load = l - cab - 0.25;
        let mut dice = Dice::new(self.seed, &[1]);
        let cargo = paint(&mut dice);
        let tarp =
            Material::new(Surface::Coach { glass: 1.0, stripe: 0.3 }, cargo).accent(paint(&mut dice)).seed(self.seed);
        out.push(PartSpec::fixed(
            Shape::cuboid(load, w, h - 0.95),
            Vec3::new(mid - 0.5 * l + 0.5 * load, 0.0, 0.5 * (h + 0.95)),
            tarp,
        ));
    }

    fn bus(&self, out: &mut Vec<PartSpec>) {
        let (l, w, h) = (self.length, self.width, self.height);
        let coach = Material::new(Surface::Coach { glass: 0.42, stripe: 0.12 }, self.paint)
            .accent(self.paint * 0.5 + Vec3::splat(0.2))
            .seed(self.seed);
        out.push(PartSpec::fixed(
            Shape::taper(l, w, h - 0.32, Vec2::new(l * 0.985, w * 0.96), Vec2::ZERO),
            Vec3::new(self.middle(), 0.0, 0.5 * (h + 0.32)),
            coach,
        ));
    }

    fn wheels(&self, rolled: f64, speed: f32, out: &mut Vec<PartSpec>) {
        let r = self.wheel;
        let angle = (rolled / f64::from(r)).rem_euclid(std::f64::consts::TAU) as f32;
        let thick = if r > 0.4 { 0.3 } else { 0.21 };
        let rim = Material::new(Surface::Wheel, rgb(150, 152, 156)).seed(self.seed);
        for x in [0.0, self.wheelbase] {
            for side in [-1.0f32, 1.0] {
                let hub = Vec3::new(x, side * (0.5 * self.width + 0.015 - 0.5 * thick), r);
                let mut wheel = Joint::new(hub, Vec3::ZERO)
                    .pitched(angle, speed / r)
                    .part(Shape::Cylinder { radius: r, half: 0.5 * thick, hole: 0.0 }, rim);
                wheel.rot *= Mat3::from_rotation_x(std::f32::consts::FRAC_PI_2);
                out.push(wheel);
            }
        }
    }
}
