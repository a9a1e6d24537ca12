//! The map topics: `map` holds the whole map for whoever joins, `map_update` the tiles that changed.

use std::time::{Duration, Instant};

use anyhow::Result;
use r2r::Node;

use super::publisher::Topic;
use crate::cdr::encode::encode_point_cloud2;
use crate::config::LiveConfig;
use crate::map::{StaticMap, TileNews};
use crate::output::cloud;
use crate::output::cloud_live::TILE_POINT_BYTES;
use crate::output::qos::Qos;
use crate::pipeline::messages::{self, Published};

/// The whole map is sent again after so long to those who listen already; a new listener gets it at once.
const WHOLE_EVERY: Duration = Duration::from_secs(10);
/// Bytes of a Gaussian in `map`.
const WHOLE_BYTES: usize = 48;

/// The topics and what was sent on them.
pub struct MapOutput {
    whole: Topic,
    update: Topic,
    last: Option<Instant>,
    whole_sent: Option<(Instant, u64)>,
    whole_listeners: usize,
    update_listeners: usize,
    news: TileNews,
    ever: bool,
}

impl MapOutput {
    /// Declares both topics.
    ///
    /// # Errors
    /// What ROS refuses.
    pub fn new(node: &mut Node) -> Result<Self> {
        let cloud = "sensor_msgs/msg/PointCloud2";
        Ok(Self {
            whole: Topic::new(node, "~/output/map", cloud, Qos::Latched)?,
            update: Topic::new(node, "~/output/map_update", cloud, Qos::Reliable)?,
            last: None,
            whole_sent: None,
            whole_listeners: 0,
            update_listeners: 0,
            news: TileNews::default(),
            ever: false,
        })
    }

    /// Both topics.
    pub fn topics(&self) -> [&Topic; 2] {
        [&self.whole, &self.update]
    }

    /// Another map took the place of the one so far: all of it is news, and what was sent of the old one is gone.
    pub fn forget(&mut self) {
        self.whole_sent = None;
        self.news.forget();
    }

    /// Whether anybody has ever listened to the map.
    pub fn was_wanted(&mut self) -> bool {
        self.ever = self.ever || self.whole.wanted() || self.update.wanted();
        self.ever
    }

    /// Sends what is due.
    ///
    /// # Errors
    /// A tile that cannot be read back from disk, or what the middleware refuses.
    pub fn offer(&mut self, map: &StaticMap, stamp_ns: i64, config: &LiveConfig, counts: &mut Published) -> Result<()> {
        if self.last.is_some_and(|last| last.elapsed().as_secs_f64() < config.map_every_sec) || map.revision() == 0 {
            return Ok(());
        }
        let (whole, update) = (self.whole.listeners(), self.update.listeners());
        let joined = whole > self.whole_listeners || (update > self.update_listeners && whole > 0);
        if update > self.update_listeners {
            self.news.start_over();
        }
        (self.whole_listeners, self.update_listeners) = (whole, update);
        if whole == 0 && update == 0 {
            return Ok(());
        }
        self.last = Some(Instant::now());
        let max_bytes = config.map_max_mb * f64::from(1 << 20);
        let news =
            self.whole_sent.is_none_or(|(at, revision)| at.elapsed() >= WHOLE_EVERY && revision != map.revision());
        if whole > 0 && (joined || news) {
            self.send_whole(map, stamp_ns, (max_bytes / WHOLE_BYTES as f64) as usize, counts)?;
        }
        if update > 0 {
            self.send_changes(map, stamp_ns, (max_bytes / TILE_POINT_BYTES as f64) as usize, counts)?;
        } else {
            self.news.clear();
        }
        Ok(())
    }

    fn send_whole(&mut self, map: &StaticMap, stamp_ns: i64, most: usize, counts: &mut Published) -> Result<()> {
        let written = map.config().max_written;
        let cloud = map.cloud_of(if written == 0 { most.max(1) } else { most.clamp(1, written) })?;
        let cloud = cloud::MapCloud {
            positions: &cloud.positions,
            colors01: &cloud.colors01,
            opacities: &cloud.opacities,
            scales: &cloud.scales,
            quats: &cloud.quats,
        };
        self.whole.send(encode_point_cloud2(&messages::map(stamp_ns, &cloud, counts)?))?;
        self.whole_sent = Some((Instant::now(), map.revision()));
        Ok(())
    }

    fn send_changes(&mut self, map: &StaticMap, stamp_ns: i64, most: usize, counts: &mut Published) -> Result<()> {
        let tiles = self.news.take(map, most)?;
        if tiles.is_empty() {
            return Ok(());
        }
        let message = messages::map_update(stamp_ns, map.config().tile_m, &tiles, counts)?;
        self.update.send(encode_point_cloud2(&message))
    }
}
