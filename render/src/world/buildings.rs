//! Houses, halls and towers beside a road.

use super::dice::Dice;
use super::layout::Layout;
use super::material::{Facade, Material, Surface, rgb};
use super::part::PartSpec;
use super::road::{District, Road};
use super::shapes::Shape;
use super::site::Site;
use super::stream::Footprint;
use glam::{DVec2, Mat3, Vec2, Vec3};
use std::f64::consts::FRAC_PI_2;

/// Metres a building stands clear of any asphalt.
const CLEAR_M: f64 = 1.2;

/// A plot's building before it is placed: x along the street, y away from it, metres.
struct Plan {
    front: f32,
    depth: f32,
    height: f32,
    setback: f64,
    roof: Roof,
    facade: Facade,
    wall: Vec3,
}

#[derive(Clone, Copy, PartialEq)]
enum Roof {
    Flat,
    Gable,
    Hip,
}

fn wall_color(dice: &mut Dice) -> Vec3 {
    let base = dice.pick(&[
        rgb(215, 205, 185),
        rgb(235, 230, 220),
        rgb(190, 180, 165),
        rgb(200, 165, 125),
        rgb(160, 95, 75),
        rgb(140, 75, 60),
        rgb(175, 130, 105),
        rgb(150, 150, 150),
        rgb(120, 125, 130),
        rgb(205, 190, 140),
        rgb(165, 180, 190),
        rgb(185, 120, 100),
        rgb(90, 95, 100),
    ]);
    base * dice.range32(0.8, 1.1)
}

impl Plan {
    fn roll(dice: &mut Dice, district: District) -> Option<Self> {
        use District::{Downtown, Industrial, Park, Rural, Suburb, Terraces};
        let gap = match district {
            Downtown => 0.05,
            Terraces => 0.08,
            Suburb => 0.12,
            Industrial => 0.25,
            Park => 0.85,
            Rural => 0.8,
        };
        if dice.chance(gap) {
            return None;
        }
        let floor = dice.range32(2.8, 3.6);
        let (front, depth, floors, setback, roof) = match district {
            Downtown => (dice.range32(10.0, 28.0), dice.range32(10.0, 20.0), 3 + dice.below(10), 0.0, Roof::Flat),
            Terraces => {
                let roof = if dice.chance(0.5) { Roof::Gable } else { Roof::Flat };
                (dice.range32(6.0, 14.0), dice.range32(9.0, 12.0), 2 + dice.below(4), dice.range(0.0, 1.5), roof)
            }
            Industrial => (
                dice.range32(15.0, 40.0),
                dice.range32(15.0, 30.0),
                2 + dice.below(2),
                dice.range(2.0, 12.0),
                Roof::Flat,
            ),
            Suburb | Park | Rural => {
                let roof = if dice.chance(0.65) { Roof::Gable } else { Roof::Hip };
                (dice.range32(8.0, 14.0), dice.range32(8.0, 11.0), 1 + dice.below(2), dice.range(3.0, 9.0), roof)
            }
        };
        let hall = district == Industrial;
        let facade = Facade {
            cell: if hall { dice.range32(4.0, 7.0) } else { dice.range32(1.8, 3.6) },
            floor,
            open: if hall {
                [0.7, dice.range32(0.15, 0.35)]
            } else {
                [dice.range32(0.35, 0.85), dice.range32(0.4, 0.7)]
            },
            shop: matches!(district, Downtown) && dice.chance(0.8) || matches!(district, Terraces) && dice.chance(0.3),
            brick: dice.chance(0.35) && !hall,
        };
        let height = floors as f32 * floor + dice.range32(0.2, 0.8);
        Some(Self { front, depth, height, setback, roof, facade, wall: wall_color(dice) })
    }

    fn parts(&self, dice: &mut Dice) -> Vec<PartSpec> {
        let mut parts = Vec::new();
        let (w, d, h) = (self.front, self.depth, self.height);
        let wall = Material::new(Surface::Facade(self.facade), self.wall)
            .accent(if self.facade.shop { wall_color(dice) * 0.5 } else { rgb(225, 222, 215) })
            .seed(dice.next());
        let base = Shape::cuboid(w, d, h);
        parts.push(PartSpec::fixed(base, Vec3::new(0.0, 0.0, 0.5 * h), wall));
        let tiles = dice.pick(&[rgb(135, 65, 45), rgb(110, 55, 45), rgb(75, 70, 70), rgb(95, 85, 75), rgb(60, 65, 75)]);
        let roof = Material::new(Surface::Courses { step: 0.35 }, tiles * dice.range32(0.8, 1.2)).seed(dice.next());
        let pitch = dice.range32(0.28, 0.5) * d;
        match self.roof {
            Roof::Gable | Roof::Hip => {
                let ridge = if self.roof == Roof::Gable { w + 0.4 } else { (w - d * 0.8).max(0.5) };
                let shape = Shape::taper(w + 0.4, d + 0.9, pitch, Vec2::new(ridge, 0.05), Vec2::ZERO);
                parts.push(PartSpec::fixed(shape, Vec3::new(0.0, 0.0, h + 0.5 * pitch), roof));
                if dice.chance(0.7) {
                    let at = Vec3::new(dice.range32(-0.3, 0.3) * w, dice.range32(-0.15, 0.15) * d, h + pitch * 0.9);
                    let brick = Material::new(Surface::Courses { step: 0.08 }, rgb(130, 75, 60));
                    parts.push(PartSpec::fixed(Shape::cuboid(0.7, 0.6, 1.6), at, brick));
                }
            }
            Roof::Flat => {
                let rim = Material::new(Surface::Plain, self.wall * 0.7);
                parts.push(PartSpec::fixed(Shape::cuboid(w + 0.3, d + 0.3, 0.5), Vec3::new(0.0, 0.0, h + 0.25), rim));
                if h > 12.0 && dice.chance(0.5) {
                    let at = Vec3::new(dice.range32(-0.2, 0.2) * w, dice.range32(-0.2, 0.2) * d, h + 1.5);
                    parts.push(PartSpec::fixed(Shape::cuboid(w * 0.3, d * 0.3, 2.5), at, rim));
                }
            }
        }
        if self.facade.shop && dice.chance(0.6) {
            let awning = dice.pick(&[rgb(150, 40, 40), rgb(40, 80, 60), rgb(40, 60, 110), rgb(210, 200, 180)]);
            let shape = Shape::taper(w * 0.7, 1.3, 0.45, Vec2::new(w * 0.7, 0.2), Vec2::new(0.0, 0.55));
            let at = Vec3::new(0.0, -0.5 * d - 0.65, 2.65);
            parts.push(PartSpec::fixed(shape, at, Material::new(Surface::Boards { step: 0.5 }, awning)));
        } else if !self.facade.shop && self.roof == Roof::Flat && h > 7.0 && dice.chance(0.5) {
            self.balconies(dice, &mut parts);
        }
        parts
    }

    fn balconies(&self, dice: &mut Dice, parts: &mut Vec<PartSpec>) {
        let slab = Material::new(Surface::Boards { step: 0.12 }, self.wall * 0.8 + Vec3::splat(0.05));
        let columns = 1 + dice.below(3);
        for column in 0..columns {
            let x = (column as f32 + 0.5) / columns as f32 * self.front - 0.5 * self.front;
            let floors = (self.height / self.facade.floor) as usize;
            for floor in 1..floors.min(6) {
                let at = Vec3::new(x, -0.5 * self.depth - 0.55, floor as f32 * self.facade.floor + 0.5);
                parts.push(PartSpec::fixed(Shape::cuboid(2.4, 1.1, 1.0), at, slab));
            }
        }
    }
}

/// Builds up both sides of a road.
pub(crate) fn line_road(site: &mut Site, road: &Road) {
    for side in [1.0, -1.0] {
        let mut dice = Dice::new(road.seed, &[50, (side > 0.0) as u64]);
        let mut s = dice.range(0.0, 6.0);
        while s < road.path.length() - 6.0 {
            let Some(plan) = Plan::roll(&mut dice, road.style.district) else {
                s += dice.range(8.0, 20.0);
                continue;
            };
            let (front, depth) = (f64::from(plan.front), f64::from(plan.depth));
            let at = road.path.at(s + 0.5 * front);
            let lateral = side * (road.style.half_width + road.style.pavement + plan.setback + 0.4 + 0.5 * depth);
            let pos = at.pos + at.left() * lateral;
            let plot = Footprint { centre: pos, dir: at.dir(), half: DVec2::new(0.5 * front, 0.5 * depth) };
            if site.claim(plot, CLEAR_M) {
                // The plan's front looks along -y: on the left the house keeps the road's heading, on the right it turns round.
                let yaw = if side > 0.0 { at.heading } else { at.heading + 2.0 * FRAC_PI_2 };
                let parts = plan.parts(&mut dice);
                site.add(pos, yaw, parts);
                s += front
                    + if matches!(road.style.district, District::Downtown | District::Terraces) {
                        0.03
                    } else {
                        dice.range(2.0, 9.0)
                    };
            } else {
                s += 4.0;
            }
        }
    }
}

/// High or broad shapes behind the first row, so that gaps do not show an empty plain.
pub(crate) fn backdrop(site: &mut Site, layout: &Layout, road: &Road) {
    let mut dice = Dice::new(road.seed, &[51]);
    let tall = match layout.town.district {
        District::Downtown => 30.0,
        District::Terraces => 16.0,
        District::Industrial => 14.0,
        _ => 8.0,
    };
    let count = (road.path.length() / 22.0) as usize;
    for _ in 0..count {
        let at = road.path.at(dice.range(-40.0, road.path.length() + 40.0));
        let pos = at.pos + at.left() * (dice.sign() * dice.range(38.0, 95.0));
        let size = [dice.range32(10.0, 26.0), dice.range32(10.0, 22.0), dice.range32(0.5, 1.6) * tall as f32];
        let yaw = at.heading + dice.range(-0.2, 0.2);
        let half = DVec2::new(f64::from(size[0]), f64::from(size[1])) * 0.5;
        let plot = Footprint { centre: pos, dir: DVec2::from_angle(yaw), half };
        let rural = matches!(road.style.district, District::Rural | District::Park);
        if dice.chance(if rural { 0.25 } else { 0.9 }) && site.claim(plot, 6.0) {
            let facade =
                Facade { cell: dice.range32(2.0, 4.0), floor: 3.1, open: [0.5, 0.5], shop: false, brick: false };
            let wall = Material::new(Surface::Facade(facade), wall_color(&mut dice)).seed(dice.next());
            let shape = Shape::cuboid(size[0], size[1], size[2]);
            let body = PartSpec::fixed(shape, Vec3::new(0.0, 0.0, 0.5 * size[2]), wall);
            let mut parts = vec![body];
            if size[2] < 12.0 {
                let pitch = 0.35 * size[1];
                let roof = Shape::taper(size[0] + 0.4, size[1] + 0.8, pitch, Vec2::new(size[0], 0.05), Vec2::ZERO);
                let tiles =
                    Material::new(Surface::Courses { step: 0.4 }, dice.pick(&[rgb(130, 65, 50), rgb(80, 75, 75)]));
                parts.push(PartSpec::fixed(roof, Vec3::new(0.0, 0.0, size[2] + 0.5 * pitch), tiles));
            }
            site.add(pos, yaw, parts);
        }
    }
    // A house across the end of every road that stops somewhere.
    for (s, out) in [(0.0, -1.0), (road.path.length(), 1.0)] {
        let at = road.path.at(s);
        let pos = at.pos + at.dir() * (out * 12.0);
        let plot = Footprint { centre: pos, dir: at.left(), half: DVec2::new(road.style.half_width + 4.0, 6.0) };
        if site.claim(plot, 0.4) {
            let h = dice.range32(5.0, 14.0);
            let facade = Facade { cell: 2.6, floor: 3.0, open: [0.5, 0.5], shop: false, brick: dice.chance(0.5) };
            let wall = Material::new(Surface::Facade(facade), wall_color(&mut dice)).seed(dice.next());
            let shape = Shape::cuboid(plot.half.x as f32 * 2.0, 12.0, h);
            let part = PartSpec::fixed(shape, Vec3::new(0.0, 0.0, 0.5 * h), wall);
            site.add(pos, at.heading + FRAC_PI_2, vec![part.turned(Mat3::IDENTITY)]);
        }
    }
}
