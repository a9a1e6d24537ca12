//! Moving objects against the truth: grouping, velocity, identity.

use std::collections::{BTreeMap, HashMap};

use anyhow::Result;
use serde::Serialize;
use storm_model::metrics::Mean;
use storm_model::metrics::mask::foreground_ari;
use storm_render::world::Drive;

use crate::config::ObjectsConfig;
use crate::objects::ObjectTracker;

use super::oracle::OracleSet;

/// The second an object's acceleration is measured over.
const SLOPE_SEC: f64 = 1.0;

/// How good the objects are.
#[derive(Debug, Clone, Default, Serialize)]
pub struct ObjectFigures {
    /// Mean adjusted Rand index over the pixels of moving road users, per step with at least two of them.
    pub fg_ari: Option<f64>,
    /// Share of moving pixels that belong to an object.
    pub covered: Option<f64>,
    /// Mean error of velocity of confirmed objects against their road user's, m/s.
    pub velocity_error_mps: Option<f64>,
    /// Mean error of acceleration over the last second against their road user's, m/s^2.
    pub acceleration_error_mps2: Option<f64>,
    /// The same of saying that nobody ever changes speed.
    pub no_acceleration_error_mps2: Option<f64>,
    /// Road users that were followed.
    pub road_users: usize,
    /// Times a road user's object became another one, per road user.
    pub switches_each: f64,
    /// Objects per road user.
    pub objects_each: f64,
}

/// Judges step by step.
#[derive(Default)]
pub struct ObjectJudge {
    ari: Mean,
    covered: Mean,
    velocity: Mean,
    acceleration: Mean,
    no_acceleration: Mean,
    /// Per road user: its object of the last step, all its objects, switches.
    followed: BTreeMap<u16, (u32, Vec<u32>, usize)>,
}

impl ObjectJudge {
    /// Takes a step: which pixels (of all cameras, row by row) were offered, and to which objects they went.
    pub fn step(
        &mut self,
        drive: &Drive,
        set: &OracleSet,
        pixels: &[usize],
        owners: &[Option<u32>],
        tracker: &ObjectTracker,
        config: &ObjectsConfig,
    ) -> Result<()> {
        let per_camera = set.frames.first().map_or(0, |f| f.width * f.height);
        let n = per_camera * set.frames.len();
        let mut found = vec![0u32; n];
        for (&p, owner) in pixels.iter().zip(owners) {
            // 0 is nobody's.
            found[p] = owner.map_or(0, |o| o + 1);
        }
        let truth: Vec<u32> = set
            .frames
            .iter()
            .flat_map(|f| f.instance.iter().zip(&f.moving).map(|(&i, &m)| if m > 0 { u32::from(i) } else { 0 }))
            .collect();
        let mut users: Vec<u32> = truth.iter().copied().filter(|&t| t > 0).collect();
        users.sort_unstable();
        users.dedup();
        if users.len() >= 2 {
            self.ari.add(foreground_ari(&found, &truth, 0)?);
        }
        let mut votes: BTreeMap<u16, HashMap<u32, usize>> = BTreeMap::new();
        for (t, f) in truth.iter().zip(&found).filter(|(t, _)| **t > 0) {
            self.covered.add(Some(f64::from(u8::from(*f > 0))));
            if *f > 0 {
                *votes.entry(*t as u16).or_default().entry(f - 1).or_default() += 1;
            }
        }
        let (movers, earlier) = (drive.movers(set.time_sec), drive.movers(set.time_sec - SLOPE_SEC));
        for (instance, votes) in votes {
            let Some((&object, _)) = votes.iter().max_by_key(|(o, n)| (**n, u32::MAX - **o)) else { continue };
            let Some(o) = tracker.live().iter().find(|o| o.id == object && o.confirmed(config)) else { continue };
            if let Some(m) = movers.iter().find(|m| m.instance == instance) {
                self.velocity.add(Some((o.velocity_mps() - m.velocity_mps).length()));
                let before = earlier.iter().find(|e| e.id == m.id);
                if let Some((own, before)) = o.acceleration_mps2().zip(before).filter(|_| o.age_sec() >= SLOPE_SEC) {
                    let truth = (m.velocity_mps - before.velocity_mps) / SLOPE_SEC;
                    self.acceleration.add(Some((own - truth).length()));
                    self.no_acceleration.add(Some(truth.length()));
                }
            }
            let entry = self.followed.entry(instance).or_insert_with(|| (object, Vec::new(), 0));
            entry.2 += usize::from(entry.0 != object);
            entry.0 = object;
            if !entry.1.contains(&object) {
                entry.1.push(object);
            }
        }
        Ok(())
    }

    /// The figures.
    pub fn finish(self) -> ObjectFigures {
        let n = self.followed.len().max(1) as f64;
        ObjectFigures {
            fg_ari: self.ari.value(),
            covered: self.covered.value(),
            velocity_error_mps: self.velocity.value(),
            acceleration_error_mps2: self.acceleration.value(),
            no_acceleration_error_mps2: self.no_acceleration.value(),
            road_users: self.followed.len(),
            switches_each: self.followed.values().map(|f| f.2).sum::<usize>() as f64 / n,
            objects_each: self.followed.values().map(|f| f.1.len()).sum::<usize>() as f64 / n,
        }
    }
}
