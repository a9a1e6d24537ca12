//! The map after very many looks, and very far away.

use anyhow::Result;
use glam::{DQuat, DVec3};
use storm_render::Gaussians;

use super::subject::Size;
use super::{Case, Finding, Sheet, worst};
use crate::config::MapConfig;
use crate::map::{MapWindow, StaticMap};
use crate::rigid::Rigid;

/// A running mean in f32 with its weight capped: the last thousand looks count, each known to 1e-7 of a tile.
const LIMIT_M: f64 = 2e-3;
/// Looks lie this far on either side of the place, metres.
const SPREAD_M: f32 = 0.02;
/// Their own standard deviation, metres.
const OWN_M: f32 = 0.01;
/// Gaussians of one look, a multiple of 6.
const PER_LOOK: usize = 1002;

pub fn run(size: Size, found: &mut dyn FnMut(Case)) -> Result<()> {
    let looks = match size {
        Size::Full => 1000,
        Size::Reduced => 20,
    };
    let mut sheet = Sheet { group: "map", against: "the surface's true place, m", limit: LIMIT_M, found };
    for metres in [0.0, 1e5, 1e7] {
        let origin = DVec3::new(metres, -metres, 0.0);
        sheet.add(
            format!("{} fusions of one cell, {metres:e} m from the origin", looks * PER_LOOK),
            one_cell(looks, origin),
        );
    }
    sheet.add("fusing what is not finite", not_finite());
    Ok(())
}

/// Gaussians around a place in the middle of a voxel.
fn one_cell(looks: usize, origin: DVec3) -> Finding {
    let config = MapConfig::default();
    let middle = (0.5 * config.voxel_m) as f32;
    let place = [3.0 + middle, 2.0 + middle, 1.0 + middle];
    let mut g = Gaussians::default();
    for k in 0..PER_LOOK {
        let side = if k % 2 == 0 { SPREAD_M } else { -SPREAD_M };
        let mut mean = place;
        mean[k / 2 % 3] += side;
        g.means.push(mean);
        push_plain(&mut g, [OWN_M; 3], 0.8);
    }
    let mut map = StaticMap::new(&config);
    let anchor = Rigid::new(DQuat::IDENTITY, origin);
    for look in 0..looks {
        map.fuse(&look_at(&g, &anchor, look as i64 * 100_000_000), |_| Some(0.8), |_| [0.25, 0.5, 0.75]);
    }
    let Ok(cloud) = map.cloud() else {
        return Finding { worst_error: f64::INFINITY, ..Finding::default() };
    };
    let mut finding = Finding { nonfinite: nonfinite(&cloud), ..Finding::default() };
    if cloud.len() != 1 {
        finding.worst_error = f64::INFINITY;
        return finding;
    }
    let truth = origin + DVec3::from_array(place.map(f64::from));
    let got = cloud.origin + DVec3::from_array(cloud.positions[0].map(f64::from));
    finding.worst_error = (got - truth).length();
    // Moment matching: the spread of the looks, a third of them along each axis, is in the covariance, added to their own.
    // The two larger axes are made to fill the voxel; the smallest is left as it is.
    let expected = (f64::from(SPREAD_M).powi(2) / 3.0 + f64::from(OWN_M).powi(2)).sqrt();
    let thin = f64::from(cloud.scales[0].iter().copied().fold(f32::INFINITY, f32::min));
    finding.worst_error = worst(finding.worst_error, (thin - expected).abs());
    let color = cloud.colors01[0].iter().zip([0.25, 0.5, 0.75]).map(|(a, b)| f64::from((a - b as f32).abs()));
    finding.worst_error = color.fold(finding.worst_error, worst);
    finding
}

/// Gaussians offered from nowhere in particular.
fn look_at<'a>(gaussians: &'a Gaussians, map_from_anchor: &'a Rigid, stamp_ns: i64) -> MapWindow<'a> {
    MapWindow { stamp_ns, map_from_anchor, gaussians, eyes: &[], pixels: 0, first_new: 0, views: &[] }
}

fn push_plain(g: &mut Gaussians, scale: [f32; 3], opacity: f32) {
    g.quats.push([1.0, 0.0, 0.0, 0.0]);
    g.scales.push(scale);
    g.opacities.push(opacity);
    g.colors.push([0.0; 3]);
    g.velocity_backward.push([0.0; 3]);
    g.velocity_forward.push([0.0; 3]);
    g.time_sec.push(0.0);
}

/// One good Gaussian among broken ones: it alone is kept.
fn not_finite() -> Finding {
    let mut g = Gaussians::default();
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX] {
        for part in 0..3 {
            g.means.push(if part == 0 { [value, 0.0, 0.0] } else { [1.0, 2.0, 3.0] });
            push_plain(&mut g, if part == 1 { [value; 3] } else { [0.01; 3] }, if part == 2 { value } else { 0.5 });
        }
    }
    g.means.push([4.0, 4.0, 4.0]);
    push_plain(&mut g, [0.01; 3], 0.5);
    let mut map = StaticMap::new(&MapConfig::default());
    let anchor = Rigid::new(DQuat::IDENTITY, DVec3::ZERO);
    map.fuse(&look_at(&g, &anchor, 0), |_| Some(1.0), |_| [0.5; 3]);
    match map.cloud() {
        Ok(cloud) => {
            let kept =
                cloud.positions.iter().any(|p| DVec3::from_array(p.map(f64::from)).distance(DVec3::splat(4.0)) < 1e-3);
            Finding { nonfinite: nonfinite(&cloud), worst_error: if kept { 0.0 } else { f64::INFINITY }, refused: None }
        }
        Err(_) => Finding { worst_error: f64::INFINITY, ..Finding::default() },
    }
}

fn nonfinite(cloud: &crate::map::MapCloud) -> u64 {
    let triples = cloud.positions.iter().chain(&cloud.colors01).chain(&cloud.scales).flatten();
    let rest = cloud.quats.iter().flatten().chain(&cloud.opacities).chain(&cloud.confidences);
    triples.chain(rest).filter(|x| !x.is_finite()).count() as u64
}
