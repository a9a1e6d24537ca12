//! Which group is which object.

use crate::config::ObjectsConfig;

use super::cluster::Cluster;
use super::object::MovingObject;

/// Per group, the place in `objects` of the one it continues: pairs are taken nearest first, each object and each
/// group once, as far as places and velocities allow.
pub(super) fn match_clusters(
    objects: &[MovingObject],
    groups: &[Cluster],
    stamp_ns: i64,
    config: &ObjectsConfig,
) -> Vec<Option<usize>> {
    let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
    for (o, object) in objects.iter().enumerate() {
        let (predicted, gate_m, gate_mps) = object.expectation(stamp_ns, config);
        for (g, group) in groups.iter().enumerate() {
            let apart = (group.center - predicted).length();
            if apart <= gate_m && (group.velocity - object.velocity_mps()).length() <= gate_mps {
                pairs.push((apart, o, g));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
    let (mut taken, mut matched) = (vec![false; objects.len()], vec![None; groups.len()]);
    for (_, o, g) in pairs {
        if !taken[o] && matched[g].is_none() {
            taken[o] = true;
            matched[g] = Some(o);
        }
    }
    matched
}
