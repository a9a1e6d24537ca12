//! Everything that belongs to one leg, made when the ego comes near and dropped when it has passed.

use super::buildings;
use super::layout::Layout;
use super::site::{Site, StaticBody};
use super::street;
use super::traffic::{Convoy, Flow, leg_flows};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

/// A leg's content.
#[derive(Debug)]
pub(crate) struct LegContent {
    pub bodies: Vec<StaticBody>,
    pub flows: Vec<Flow>,
    /// Which slots of which stream may exist, as far as anybody asked.
    known: Mutex<HashMap<(u32, i64), bool>>,
}

impl LegContent {
    fn new(layout: &Layout, index: usize) -> Self {
        let mut site = Site::new(layout, index);
        let mut parked = 0;
        if let Some(leg) = layout.legs.get(index) {
            for road in &layout.roads[leg.road..leg.roads_end] {
                buildings::line_road(&mut site, road);
            }
            for road in &layout.roads[leg.road..leg.roads_end] {
                street::furnish(&mut site, road, &mut parked);
            }
            for road in &layout.roads[leg.road..leg.roads_end] {
                buildings::backdrop(&mut site, layout, road);
            }
        }
        Self { bodies: site.bodies, flows: leg_flows(layout, index), known: Mutex::default() }
    }

    /// Whether a parked vehicle may pull out: `free` says whether nobody of the ego's convoy is in its way, and is asked once.
    pub(crate) fn leaves(&self, body: usize, free: impl FnOnce() -> bool) -> bool {
        // No flow has this number.
        let key = (u32::MAX, body as i64);
        let lock = || self.known.lock().unwrap_or_else(PoisonError::into_inner);
        let known = lock().get(&key).copied();
        known.unwrap_or_else(|| {
            let free = free();
            lock().insert(key, free);
            free
        })
    }

    pub(crate) fn exists(&self, flow: usize, slot: i64, convoy: &Convoy, seconds: f64) -> bool {
        let key = (flow as u32, slot);
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(found) = known.get(&key) {
            return *found;
        }
        let exists = self.flows.get(flow).is_some_and(|f| f.exists(slot, &self.flows, convoy, seconds));
        known.insert(key, exists);
        exists
    }
}

/// Most legs kept at once; a view needs five, and cameras that look at other times a few more.
const KEEP: usize = 8;

/// The legs made so far. What a leg holds follows from the layout alone, so it makes no difference who made it when.
#[derive(Debug, Default)]
pub(crate) struct LegStore(Mutex<HashMap<usize, Arc<LegContent>>>);

impl LegStore {
    pub(crate) fn get(&self, layout: &Layout, index: usize) -> Arc<LegContent> {
        let find = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(leg) = find().get(&index) {
            return leg.clone();
        }
        let made = Arc::new(LegContent::new(layout, index));
        let mut legs = find();
        // A replay moves on along the route: what lies farthest is not asked for again.
        while legs.len() >= KEEP
            && let Some(far) = legs.keys().copied().max_by_key(|i| i.abs_diff(index))
        {
            legs.remove(&far);
        }
        legs.entry(index).or_insert(made).clone()
    }
}
