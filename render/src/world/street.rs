//! What stands along a road: parked vehicles, trees, lamps, signs, lights, fences, hedges and odds and ends.

use super::dice::Dice;
use super::layout::Town;
use super::material::{Material, Surface, rgb};
use super::part::PartSpec;
use super::road::{District, Road};
use super::shapes::Shape;
use super::site::{Site, StaticBody};
use super::stream::{Footprint, Model};
use super::traffic::{ID_PARKED, parked_ids, parking_lateral};
use super::vehicles::VehicleModel;
use glam::{DVec2, Mat3, Vec2, Vec3};
use std::f64::consts::{FRAC_PI_2, PI};

/// Kind of tree.
#[derive(Clone, Copy)]
enum Tree {
    Round,
    Tall,
    Conifer,
    Bush,
}

fn tree(dice: &mut Dice, town: &Town, kind: Tree) -> Vec<PartSpec> {
    let mut parts = Vec::new();
    let season = Dice::new(town.seed, &[60]).below(4);
    let green = [rgb(85, 110, 50), rgb(60, 95, 45), rgb(150, 120, 45), rgb(75, 100, 60)][season];
    let green = green * dice.range32(0.6, 1.1);
    let leaf = |dice: &mut Dice| Material::new(Surface::Leaves, green * dice.range32(0.8, 1.2)).seed(dice.next());
    let bark = Material::new(Surface::Rough, rgb(85, 70, 55));
    let trunk = |height: f32, radius: f32| {
        let shape = Shape::Cylinder { radius, half: 0.5 * height + 0.1, hole: 0.0 };
        PartSpec::fixed(shape, Vec3::new(0.0, 0.0, 0.5 * height - 0.1), bark)
    };
    match kind {
        Tree::Round => {
            let h = dice.range32(5.0, 10.0);
            let crown = h * dice.range32(0.24, 0.34);
            parts.push(trunk(h * 0.5, h * 0.022 + 0.03));
            let core = Vec3::new(0.0, 0.0, h * 0.66);
            parts.push(PartSpec::fixed(
                Shape::Ellipsoid { radii: Vec3::new(crown, crown, crown * 1.05) * 0.85 },
                core,
                leaf(dice),
            ));
            for k in 0..5 {
                let angle = k as f32 * 1.257 + dice.range32(-0.4, 0.4);
                let r = crown * dice.range32(0.45, 0.62);
                let at = core
                    + Vec3::new(
                        angle.cos() * crown * 0.6,
                        angle.sin() * crown * 0.6,
                        dice.range32(-0.35, 0.45) * crown,
                    );
                parts.push(PartSpec::fixed(Shape::Ellipsoid { radii: Vec3::new(r, r, r * 0.85) }, at, leaf(dice)));
            }
        }
        Tree::Tall => {
            let h = dice.range32(8.0, 14.0);
            parts.push(trunk(h * 0.3, 0.2));
            for k in 0..4 {
                let r = h * dice.range32(0.08, 0.11);
                let at = Vec3::new(dice.range32(-0.3, 0.3), dice.range32(-0.3, 0.3), h * (0.3 + 0.18 * k as f32));
                parts.push(PartSpec::fixed(Shape::Ellipsoid { radii: Vec3::new(r, r, h * 0.18) }, at, leaf(dice)));
            }
        }
        Tree::Conifer => {
            let h = dice.range32(5.0, 12.0);
            parts.push(trunk(h * 0.25, 0.15));
            for k in 0..4 {
                let w = h * (0.36 - 0.07 * k as f32);
                let shape = Shape::taper(w, w, h * 0.36, Vec2::splat(w * 0.12), Vec2::ZERO);
                let at = Vec3::new(0.0, 0.0, h * (0.3 + 0.17 * k as f32));
                let turn = Mat3::from_rotation_z(k as f32 * 0.7);
                parts.push(PartSpec::fixed(shape, at, leaf(dice)).turned(turn));
            }
        }
        Tree::Bush => {
            for _ in 0..1 + dice.below(3) {
                let r = dice.range32(0.4, 1.0);
                let at = Vec3::new(dice.range32(-0.8, 0.8), dice.range32(-0.5, 0.5), r * 0.6);
                parts.push(PartSpec::fixed(Shape::Ellipsoid { radii: Vec3::new(r, r, r * 0.8) }, at, leaf(dice)));
            }
        }
    }
    parts
}

fn any_tree(dice: &mut Dice, town: &Town) -> Vec<PartSpec> {
    let kind = dice.pick(&[Tree::Round, Tree::Round, Tree::Round, Tree::Tall, Tree::Conifer, Tree::Bush]);
    tree(dice, town, kind)
}

/// A lamp with its arm along -y (towards the road from the left side).
fn lamp(dice: &mut Dice) -> Vec<PartSpec> {
    let metal = Material::new(Surface::Sheen, dice.pick(&[rgb(110, 112, 115), rgb(60, 65, 62), rgb(140, 142, 140)]));
    let h = dice.range32(5.5, 9.0);
    let arm = dice.range32(0.8, 2.0);
    let pole = Shape::Cylinder { radius: 0.075, half: 0.5 * h, hole: 0.0 };
    let head = Material::new(Surface::Lamp, rgb(210, 210, 205));
    vec![
        PartSpec::fixed(pole, Vec3::new(0.0, 0.0, 0.5 * h), metal),
        PartSpec::bar(Vec3::new(0.0, 0.0, h), Vec3::new(0.0, -arm, h + 0.3), 0.05, metal),
        PartSpec::fixed(Shape::cuboid(0.25, 0.6, 0.12), Vec3::new(0.0, -arm, h + 0.28), head),
    ]
}

/// A sign that faces -x.
fn sign(dice: &mut Dice) -> Vec<PartSpec> {
    let metal = Material::new(Surface::Sheen, rgb(140, 142, 145));
    let h = dice.range32(2.2, 2.9);
    let pole = Shape::Cylinder { radius: 0.035, half: 0.5 * h, hole: 0.0 };
    let (white, red, blue, yellow) = (rgb(235, 235, 235), rgb(190, 25, 30), rgb(25, 70, 165), rgb(240, 190, 30));
    let (color, rim) =
        dice.pick(&[(white, red), (red, white), (blue, white), (yellow, rgb(20, 20, 20)), (white, blue)]);
    let round = dice.chance(0.5);
    let plate = Material::new(Surface::Sign { round }, color).accent(rim).seed(dice.next());
    let at = Vec3::new(-0.06, 0.0, h - 0.1);
    let part = if round {
        let disc = Shape::Cylinder { radius: 0.34, half: 0.02, hole: 0.0 };
        PartSpec::fixed(disc, at, plate).turned(Mat3::from_rotation_y(-std::f32::consts::FRAC_PI_2))
    } else if dice.chance(0.4) {
        let up = if dice.chance(0.5) { Vec2::new(0.04, 0.06) } else { Vec2::new(0.04, 0.55) };
        PartSpec::fixed(Shape::taper(0.04, 0.8, 0.7, up, Vec2::ZERO), at, plate)
    } else {
        PartSpec::fixed(Shape::cuboid(0.04, dice.range32(0.5, 0.9), dice.range32(0.5, 0.9)), at, plate)
    };
    vec![PartSpec::fixed(pole, Vec3::new(0.0, 0.0, 0.5 * h), metal), part]
}

/// Traffic lights that face -x.
fn lights(dice: &mut Dice) -> Vec<PartSpec> {
    let metal = Material::new(Surface::Sheen, rgb(70, 72, 75));
    let lamp = dice.below(3) as u8;
    let head = Material::new(Surface::Signal { lamp }, rgb(22, 24, 22));
    let pole = Shape::Cylinder { radius: 0.06, half: 1.6, hole: 0.0 };
    let at = Vec3::new(-0.16, 0.0, 2.8);
    let mut parts = vec![
        PartSpec::fixed(pole, Vec3::new(0.0, 0.0, 1.6), metal),
        PartSpec::fixed(Shape::cuboid(0.22, 0.34, 0.95), at, head),
    ];
    if dice.chance(0.4) {
        let reach = dice.range32(3.0, 5.5);
        parts.push(PartSpec::fixed(
            Shape::Cylinder { radius: 0.09, half: 2.9, hole: 0.0 },
            Vec3::new(0.3, 0.0, 2.9),
            metal,
        ));
        parts.push(PartSpec::bar(Vec3::new(0.3, 0.0, 5.6), Vec3::new(0.3, -reach, 5.9), 0.06, metal));
        parts.push(PartSpec::fixed(Shape::cuboid(0.22, 0.34, 0.95), Vec3::new(0.1, -reach, 5.6), head));
    }
    parts
}

fn oddment(dice: &mut Dice) -> Vec<PartSpec> {
    let metal = |c| Material::new(Surface::Sheen, c);
    let fixed = |shape, z: f32, m| PartSpec::fixed(shape, Vec3::new(0.0, 0.0, z), m);
    match dice.below(6) {
        0 => vec![fixed(Shape::Cylinder { radius: 0.25, half: 0.45, hole: 0.0 }, 0.45, metal(rgb(60, 80, 60)))],
        1 => vec![fixed(
            Shape::cuboid(0.5, 0.45, 1.15),
            0.57,
            metal(dice.pick(&[rgb(200, 40, 40), rgb(215, 180, 40), rgb(40, 70, 140)])),
        )],
        2 => {
            let wood = Material::new(Surface::Boards { step: 0.12 }, rgb(125, 90, 60));
            vec![
                fixed(Shape::cuboid(1.6, 0.45, 0.06), 0.46, wood),
                PartSpec::fixed(Shape::cuboid(1.6, 0.06, 0.4), Vec3::new(0.0, 0.24, 0.72), wood),
                PartSpec::fixed(Shape::cuboid(0.08, 0.4, 0.44), Vec3::new(0.6, 0.0, 0.22), metal(rgb(50, 50, 50))),
                PartSpec::fixed(Shape::cuboid(0.08, 0.4, 0.44), Vec3::new(-0.6, 0.0, 0.22), metal(rgb(50, 50, 50))),
            ]
        }
        3 => {
            let poster = Material::new(Surface::Poster, rgb(220, 220, 215)).seed(dice.next());
            vec![
                fixed(Shape::cuboid(0.12, 1.3, 1.9), 1.35, poster),
                fixed(Shape::cuboid(0.1, 0.1, 0.5), 0.25, metal(rgb(60, 60, 60))),
            ]
        }
        4 => vec![fixed(Shape::cuboid(1.1, 0.45, 1.3), 0.65, metal(rgb(120, 125, 120)))],
        _ => (-1..=1)
            .map(|k| {
                let at = Vec3::new(k as f32 * 1.4, 0.0, 0.45);
                PartSpec::fixed(Shape::Cylinder { radius: 0.07, half: 0.45, hole: 0.0 }, at, metal(rgb(90, 92, 95)))
            })
            .collect(),
    }
}

/// A fence, wall or hedge of `length` metres along x.
fn fence(dice: &mut Dice, town: &Town, length: f32) -> Vec<PartSpec> {
    let (height, thick, surface, color) = match dice.below(4) {
        0 => {
            let season = Dice::new(town.seed, &[60]).below(4);
            let green = [rgb(80, 105, 50), rgb(55, 90, 45), rgb(120, 110, 50), rgb(75, 100, 60)][season];
            (dice.range32(0.8, 2.0), dice.range32(0.5, 0.9), Surface::Leaves, green * 0.8)
        }
        1 => (
            dice.range32(0.6, 1.8),
            0.25,
            Surface::Courses { step: 0.075 },
            dice.pick(&[rgb(150, 85, 65), rgb(170, 160, 145)]),
        ),
        2 => (
            dice.range32(0.9, 1.8),
            0.06,
            Surface::Boards { step: 0.14 },
            dice.pick(&[rgb(140, 105, 70), rgb(225, 225, 220), rgb(90, 75, 60)]),
        ),
        _ => {
            let metal = Material::new(Surface::Sheen, dice.pick(&[rgb(40, 45, 42), rgb(130, 132, 135)]));
            let mut parts = vec![
                PartSpec::fixed(Shape::cuboid(length, 0.05, 0.06), Vec3::new(0.0, 0.0, 1.05), metal),
                PartSpec::fixed(Shape::cuboid(length, 0.05, 0.06), Vec3::new(0.0, 0.0, 0.55), metal),
            ];
            let posts = (length / 2.0).ceil().max(1.0);
            for k in 0..=posts as usize {
                let x = (k as f32 / posts - 0.5) * length;
                parts.push(PartSpec::fixed(Shape::cuboid(0.07, 0.07, 1.15), Vec3::new(x, 0.0, 0.57), metal));
            }
            return parts;
        }
    };
    let material = Material::new(surface, color).seed(dice.next());
    vec![PartSpec::fixed(Shape::cuboid(length, thick, height), Vec3::new(0.0, 0.0, 0.5 * height), material)]
}

/// Furnishes both sides of a road.
pub(crate) fn furnish(site: &mut Site, road: &Road, parked: &mut u32) {
    park(site, road, parked);
    signs(site, road);
    for side in [1.0, -1.0] {
        row(site, road, side);
        gardens(site, road, side);
    }
}

fn park(site: &mut Site, road: &Road, parked: &mut u32) {
    let town = &site.layout.town;
    for (k, side) in [(0, 1.0), (1, -1.0)] {
        if !road.style.parking[k] {
            continue;
        }
        let mut dice = Dice::new(road.seed, &[61, k as u64]);
        let fill = dice.range(0.3, 0.95);
        let big = if road.style.district == District::Industrial { 0.35 } else { 0.08 };
        // Parked the way traffic drives on that side.
        let forward = side * town.hand < 0.0;
        let mut s = dice.range(2.0, 8.0);
        while s < road.path.length() - 8.0 {
            let model = VehicleModel::roll(&mut dice, big);
            let length = f64::from(model.length);
            let at = road.path.at(s + 0.5 * length);
            let keep = dice.chance(fill) && model.height < 3.2;
            let clear = road.clear_of_crossings(s + 0.5 * length) > 0.5 * length + 6.0;
            let lateral = side * (parking_lateral(road) + dice.range(-0.1, 0.15));
            let middle = at.pos + at.left() * lateral;
            // Other roads, a turning leg's for one, may cover this stretch.
            let alone = site
                .layout
                .roads_near(site.leg, 1)
                .all(|i| i == road.index || site.layout.roads[i].edge_distance(middle) > 0.5 * length + 2.0);
            if keep && clear && alone && *parked < ID_PARKED {
                let yaw = at.heading + if forward { 0.0 } else { PI } + dice.range(-0.02, 0.02);
                let origin = middle - DVec2::from_angle(yaw) * f64::from(model.middle());
                let mut parts = Vec::new();
                model.parts(dice.range(0.0, 2.0), 0.0, &mut parts);
                let mut body = StaticBody::new(origin.extend(0.0), yaw, parts);
                body.instance = (parked_ids(site.leg) + *parked) as u16;
                body.model = Some(Model::Vehicle(model));
                site.bodies.push(body);
                *parked += 1;
            }
            s += length + dice.range(0.7, 2.5);
        }
    }
}

/// Signs and traffic lights where the road meets others, facing those who come.
fn signs(site: &mut Site, road: &Road) {
    let town = site.layout.town;
    let mut dice = Dice::new(road.seed, &[62]);
    let put = |site: &mut Site, s: f64, direction: f64, parts: Vec<PartSpec>| {
        let at = road.path.at(s);
        let side = -town.hand * direction;
        let pos = at.pos + at.left() * (side * (road.style.half_width + 0.55));
        if site.beside_roads(pos, 0.35) {
            site.add(pos, if direction > 0.0 { at.heading } else { at.heading + PI }, parts);
        }
    };
    for c in &road.crossings {
        for direction in [1.0, -1.0] {
            let s = c.s - direction * (c.wide + town.corner + 1.2);
            if c.lights {
                put(site, s, direction, lights(&mut dice));
            } else if dice.chance(0.8) {
                put(site, s, direction, sign(&mut dice));
            }
        }
    }
    let mut s = dice.range(5.0, 30.0);
    while s < road.path.length() {
        let direction = dice.sign();
        put(site, s, direction, sign(&mut dice));
        s += dice.range(20.0, 70.0);
    }
}

/// The row along the kerb: lamps and trees at intervals, oddments between.
fn row(site: &mut Site, road: &Road, side: f64) {
    use District::{Downtown, Industrial, Park, Rural, Suburb, Terraces};
    let town = site.layout.town;
    let mut dice = Dice::new(road.seed, &[63, (side > 0.0) as u64]);
    let lamps = dice.chance(0.75);
    let trees = match road.style.district {
        Park => 0.9,
        Suburb | Rural => 0.6,
        Downtown | Terraces => 0.45,
        Industrial => 0.25,
    };
    let trees = dice.chance(trees);
    let kind = dice.pick(&[Tree::Round, Tree::Round, Tree::Tall, Tree::Conifer]);
    let step = dice.range(9.0, 16.0);
    let mut s = dice.range(1.0, step);
    let mut k = dice.below(3);
    while s < road.path.length() {
        let at = road.path.at(s + dice.range(-0.8, 0.8));
        let yaw = if side > 0.0 { at.heading } else { at.heading + PI };
        let beside = |d: f64| at.pos + at.left() * (side * (road.style.half_width + d));
        let pos = beside(0.6);
        if k.is_multiple_of(3) && lamps && site.beside_roads(pos, 0.4) {
            site.add(pos, yaw, lamp(&mut dice));
        } else if trees && dice.chance(0.85) {
            let pos = if road.style.district == Rural { beside(dice.range(2.0, 5.0)) } else { beside(0.8) };
            if site.beside_roads(pos, 0.5) {
                site.add(pos, dice.range(0.0, 6.0), tree(&mut dice, &town, kind));
            }
        } else if dice.chance(0.35) {
            let pos = beside(road.style.pavement.max(0.8) - 0.1);
            if site.beside_roads(pos, 0.6) {
                site.add(pos, yaw, oddment(&mut dice));
            }
        }
        k += 1;
        s += step;
    }
}

/// Behind the pavement: fences and hedges, garden trees, groves.
fn gardens(site: &mut Site, road: &Road, side: f64) {
    use District::{Downtown, Industrial, Park, Rural, Suburb, Terraces};
    let town = site.layout.town;
    let mut dice = Dice::new(road.seed, &[64, (side > 0.0) as u64]);
    let (fences, woods) = match road.style.district {
        Downtown => (0.0, 0.02),
        Terraces => (0.1, 0.06),
        Suburb => (0.7, 0.5),
        Park => (0.3, 2.2),
        Industrial => (0.45, 0.12),
        Rural => (0.3, 0.7),
    };
    let mut s = 1.0;
    while s < road.path.length() - 4.0 {
        let length = dice.range(5.0, 14.0);
        let at = road.path.at(s + 0.5 * length);
        let front = side * (road.style.half_width + road.style.pavement + 0.45);
        if dice.chance(fences) && at.curvature.abs() < 0.012 {
            let pos = at.pos + at.left() * front;
            let plot = Footprint { centre: pos, dir: at.dir(), half: DVec2::new(0.5 * length - 0.1, 0.3) };
            if site.claim(plot, road.style.pavement.min(1.5)) {
                let parts = fence(&mut dice, &town, length as f32 - 0.2);
                site.add(pos, at.heading, parts);
            }
        }
        let count = (woods * dice.range(0.3, 1.7) * 1.5).round() as usize;
        for _ in 0..count {
            let d =
                front + side * dice.range(1.5, if matches!(road.style.district, Park | Rural) { 45.0 } else { 14.0 });
            let pos = road.path.at(s + dice.range(0.0, length)).pos + at.left() * d;
            let plot = Footprint { centre: pos, dir: DVec2::X, half: DVec2::splat(0.4) };
            if site.claim(plot, road.style.pavement + 0.8) {
                let parts = any_tree(&mut dice, &town);
                site.add(pos, dice.range(0.0, 2.0 * FRAC_PI_2), parts);
            }
        }
        s += length + dice.range(0.0, 3.0);
    }
}
