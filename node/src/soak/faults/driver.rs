//! Drives: makes messages, spoils them, pushes them, watches.

use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use storm_render::world::{Drive, DriveOptions};

use crate::cdr::encode;
use crate::config::Config;
use crate::engine::{Engine, ModelSource};
use crate::map::StaticMap;
use crate::msg::{CameraInfo, Header, Image, PoseStamped};
use crate::pipeline::live::{Live, LiveInput, LiveOptions, Message, Status, inbox};
use crate::pipeline::posed::PoseStore;
use crate::pipeline::timing::rss_mb;
use crate::rigid::Rigid;
use crate::source::Rig;
use crate::source::mount::PoseNames;
use crate::source::rig::CameraDescription;
use crate::source::translate::Role;
use crate::sync::DropReason;
use crate::tf::TfTree;

use super::super::memory::Memory;
use super::disk;
use super::plan::{Orders, Plan, PoseSpoil, Spoil};
use super::report::{FaultReport, LiveQuarter, checks};
use super::sink::{PushClock, Seen, Sink};

/// Stamp of the drive's time 0.
const START_NS: i64 = 1_700_000_000_000_000_000;
/// The pipeline has to have taken a frame within this time; longer is a hang.
const PATIENCE: Duration = Duration::from_secs(60);
/// Poses per frame.
const POSES: usize = 2;

/// What to drive.
#[derive(Debug, Clone)]
pub struct FaultSoak {
    /// The drive: seed, length, picture size, rate, cameras.
    pub drive: DriveOptions,
    /// The configuration.
    pub config: Config,
    /// Where the map is kept.
    pub map_dir: PathBuf,
    /// Whether the disk may be full for a while; that limits the whole process.
    pub disk: bool,
}

/// Drives through the live pipeline with faults.
///
/// # Errors
/// A pipeline that cannot be started, that hangs, or that ends by itself.
pub fn run_with_faults(options: &FaultSoak, progress: &dyn Fn(usize)) -> Result<FaultReport> {
    let start = Instant::now();
    let drive = Drive::new(&options.drive)?;
    let (frames, cameras) = (drive.frame_count(), drive.cameras().len());
    let config = configured(options, &drive);
    let orders = Orders::new();
    let mut plan = Plan::new(options.drive.seed, cameras, frames, options.disk, orders.clone());
    let mut car = Car::start(&drive, &config, orders.clone())?;
    let mut quarters = vec![LiveQuarter::default(); 4];
    let mut rss = vec![Vec::new(); 4];
    let mut shown = 0;
    for frame in 0..frames {
        car.frame(frame, &mut plan)?;
        let quarter = 4 * frame / frames.max(1);
        if frame % 10 == 0 {
            rss[quarter].extend(rss_mb());
        }
        if frame + 1 == frames || 4 * (frame + 1) / frames != quarter {
            let (status, seen) = (car.live.status(), lock(&car.seen));
            quarters[quarter] = quarter_of(&rss[quarter], &seen, &mut shown, &status);
        }
        progress(frame + 1);
    }
    if options.disk {
        disk::fill(false);
    }
    orders.calm();
    car.wait(0)?;
    let (sent, seen) = (car.sent, car.seen.clone());
    let status = car.live.stop()?;
    let saved = StaticMap::open(&options.map_dir, false).ok().map(|(map, _)| map.len() as u64);
    let seen = lock(&seen);
    let checks = checks(sent, &status, &seen, orders.panics.load(Ordering::Relaxed), saved);
    let mean = |q: &LiveQuarter| q.rss_mb[0];
    Ok(FaultReport {
        seed: options.drive.seed,
        seconds: options.drive.seconds,
        wall_sec: start.elapsed().as_secs_f64(),
        injected: plan.injected,
        images_sent: sent,
        images_in: status.images_in,
        images_used: status.images_used,
        dropped: DropReason::ALL.iter().map(|&r| (r.as_str(), status.drops.get(r))).collect(),
        sets: status.sets,
        steps: status.steps,
        steps_skipped: status.skips.skipped(),
        published: seen.steps,
        published_bytes: seen.bytes,
        panicked_steps: status.panicked_steps,
        poses_rejected: status.poses_rejected,
        epochs: status.epochs,
        failed_saves: status.failed_saves,
        spilled: seen.spilled,
        evicted: seen.evicted,
        spill_failed: seen.spill_failed,
        tiles_lost: seen.tiles_lost,
        nonfinite: seen.nonfinite,
        withheld: seen.withheld,
        memory_growth: if mean(&quarters[1]) > 0.0 { mean(&quarters[3]) / mean(&quarters[1]) - 1.0 } else { 0.0 },
        quarters,
        saved_gaussians: saved.unwrap_or(0),
        checks,
    })
}

fn lock(seen: &Mutex<Seen>) -> MutexGuard<'_, Seen> {
    seen.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The configuration with what the drive decides.
fn configured(options: &FaultSoak, drive: &Drive) -> Config {
    let mut config = options.config.clone();
    if config.model.image_width == 0 {
        (config.model.image_width, config.model.image_height) = (options.drive.width, options.drive.height);
    }
    config.live.map = "always".into();
    config.live.map_dir = options.map_dir.to_string_lossy().into_owned();
    // An hour passes in minutes here; saves follow the clock on the wall.
    config.map.save_every_sec = config.map.save_every_sec.min(1.0);
    let mount = |c: &storm_render::world::DriveCamera| {
        let Rigid { rotation: q, translation: t } = Rigid::from(&c.base_from_camera);
        [t.x, t.y, t.z, q.w, q.x, q.y, q.z]
    };
    config.input.base_from_camera = drive.cameras().iter().map(mount).collect();
    config
}

fn quarter_of(rss: &[f64], seen: &Seen, shown: &mut usize, status: &Status) -> LiveQuarter {
    let mut ms: Vec<f32> = seen.latency_ms.get(*shown..).unwrap_or(&[]).to_vec();
    *shown = seen.latency_ms.len();
    ms.sort_by(f32::total_cmp);
    let rank =
        |q: f64| ms.get(((q * ms.len() as f64).ceil() as usize).saturating_sub(1)).map_or(0.0, |x| f64::from(*x));
    let mean = rss.iter().sum::<f64>() / rss.len().max(1) as f64;
    LiveQuarter {
        rss_mb: [mean, rss.iter().copied().fold(0.0, f64::max)],
        steps: ms.len() as u64,
        latency_ms: [rank(0.5), rank(0.99), rank(1.0)],
        map_gaussians: status.map_gaussians,
        map_disk_mb: seen.disk_bytes as f64 / 1e6,
        alive: [status.tracks, status.objects],
        memory_mb: Memory::default().of_process(),
    }
}

/// The vehicle: cameras, clock, and the pipeline they send to.
struct Car<'a> {
    drive: &'a Drive,
    live: Live,
    seen: Arc<Mutex<Seen>>,
    clock: Arc<PushClock>,
    cameras: usize,
    /// Image messages sent.
    sent: u64,
    clock_ns: i64,
    /// Images that come late: when, input, bytes.
    late: Vec<(usize, usize, Vec<u8>)>,
    disk_full: bool,
}

impl<'a> Car<'a> {
    fn start(drive: &'a Drive, config: &Config, orders: Arc<Orders>) -> Result<Self> {
        let cameras = drive.cameras().len();
        let source = ModelSource::open(&config.model)?;
        let size = source.picture_size(&config.model)?;
        let described = drive.cameras().iter().enumerate().map(|(i, c)| CameraDescription {
            topic: format!("/camera{i}/image_rect"),
            info_topic: format!("/camera{i}/camera_info"),
            frame_id: Some(format!("camera{i}")),
            info: Some(CameraInfo::pinhole(
                &c.intrinsics,
                Header { stamp_ns: START_NS, frame_id: format!("camera{i}") },
            )),
            black_frame: None,
        });
        let rig =
            Rig::build(described.collect(), &TfTree::new(&config.sync), &PoseNames::default(), &config.input, size)?;
        let rig = Arc::new(rig);
        let engine = Engine::new(source, &config.model, cameras, config.window.timespan_sec)?.with_skips(&config.skip);
        let image =
            |camera| LiveInput { topic: format!("/camera{camera}"), role: Role::Image { camera, compressed: false } };
        // One input more than there are cameras: its decoder looks for a camera there is not, and panics.
        let mut inputs: Vec<LiveInput> = (0..=cameras).map(image).collect();
        let type_name = "geometry_msgs/msg/PoseStamped".into();
        inputs.push(LiveInput { topic: "/pose".into(), role: Role::Pose { type_name } });
        let (seen, clock) = (Arc::new(Mutex::new(Seen::default())), PushClock::new());
        let sink = Sink { rig: rig.clone(), config: config.clone(), seen: seen.clone(), clock: clock.clone() };
        let reader = clock.clone();
        let options = LiveOptions {
            config: config.clone(),
            rig,
            messages: inbox(&inputs, config),
            inputs,
            store: PoseStore::nothing(&config.sync),
            clock: Box::new(move || reader.now_ns()),
            on_part: Some(orders.on_part()),
        };
        let live = Live::start(options, engine, Box::new(sink))?;
        let (late, disk_full) = (Vec::new(), false);
        Ok(Self { drive, live, seen, clock, cameras, sent: 0, clock_ns: START_NS, late, disk_full })
    }

    fn push(&mut self, input: usize, data: Vec<u8>) {
        self.sent += u64::from(input <= self.cameras);
        self.live.push(input, Message { input, data, received_ns: self.clock.now_ns() });
    }

    /// Sends one frame of all cameras, and the poses around it.
    fn frame(&mut self, frame: usize, plan: &mut Plan) -> Result<()> {
        let faults = plan.frame(frame);
        if faults.disk_full != self.disk_full {
            self.disk_full = faults.disk_full;
            disk::fill(self.disk_full);
        }
        self.clock_ns = self.clock_ns.saturating_add(faults.clock_ns);
        let time_sec = self.drive.frame_time_sec(frame, 0);
        self.clock.pushed(self.stamp_ns(time_sec));
        let due: Vec<usize> = (0..self.late.len()).rev().filter(|&i| self.late[i].0 <= frame).collect();
        for i in due {
            let (_, input, data) = self.late.remove(i);
            self.push(input, data);
        }
        let mut images = Vec::new();
        for (camera, spoil) in faults.images.iter().enumerate() {
            if *spoil != Spoil::Missing {
                images.push((camera, *spoil, self.image(frame, camera, *spoil == Spoil::Poison)?));
            }
        }
        if faults.reordered {
            images.reverse();
        } else {
            self.poses(time_sec, faults.pose)?;
        }
        for (camera, spoil, mut data) in images {
            match spoil {
                Spoil::Late(by) => {
                    self.late.push((frame + by, camera, data));
                    continue;
                }
                Spoil::Duplicate => self.push(camera, data.clone()),
                Spoil::Corrupt => plan.corrupt(&mut data),
                _ => {}
            }
            let input = if spoil == Spoil::Panic { self.cameras } else { camera };
            self.push(input, data);
        }
        if faults.reordered {
            self.poses(time_sec, faults.pose)?;
        }
        match faults.burst {
            true => Ok(()),
            // One frame may be under way while the next is drawn.
            false => self.wait(self.cameras as u64 * 2),
        }
    }

    fn stamp_ns(&self, time_sec: f64) -> i64 {
        self.clock_ns.saturating_add((time_sec * 1e9).round() as i64)
    }

    fn image(&self, frame: usize, camera: usize, poison: bool) -> Result<Vec<u8>> {
        let time_sec = self.drive.frame_time_sec(frame, camera);
        let picture = self.drive.render(camera, time_sec);
        let header = Header { stamp_ns: self.stamp_ns(time_sec), frame_id: format!("camera{camera}") };
        let (width, height) = (picture.width as u32, picture.height as u32);
        let (encoding, step, data) = match poison {
            true => ("32FC3", 12, f32::NAN.to_le_bytes().repeat(picture.rgb.len())),
            false => ("rgb8", 3, picture.rgb),
        };
        let image =
            Image { header, height, width, encoding: encoding.into(), is_bigendian: false, step: step * width, data };
        Ok(encode::encode_image(&image)?)
    }

    fn poses(&mut self, time_sec: f64, spoil: PoseSpoil) -> Result<()> {
        let period_sec = 1.0 / self.drive.options().rate_hz;
        for k in 0..POSES {
            let time_sec = time_sec + k as f64 * period_sec / POSES as f64;
            let mut pose = Rigid::from(&self.drive.map_from_base(time_sec));
            match spoil {
                PoseSpoil::None => {}
                PoseSpoil::Missing => continue,
                PoseSpoil::Nan => pose.translation.y = f64::NAN,
                PoseSpoil::Jump(by_m) => pose.translation.x += by_m,
            }
            let header = Header { stamp_ns: self.stamp_ns(time_sec), frame_id: "map".into() };
            let message = PoseStamped { header, child_frame_id: String::new(), pose };
            let data = encode::encode_pose_stamped(&message)?;
            self.push(self.cameras + 1, data);
        }
        Ok(())
    }

    /// Waits until all but `ahead` image messages were taken.
    fn wait(&self, ahead: u64) -> Result<()> {
        let start = Instant::now();
        loop {
            let taken = self.live.status().images_in;
            if taken + ahead >= self.sent {
                return Ok(());
            }
            if self.live.broken() {
                bail!("the pipeline ended by itself after {} image messages", self.sent);
            }
            if start.elapsed() > PATIENCE {
                return Err(anyhow::anyhow!("{taken} of {} image messages were taken", self.sent))
                    .context(format!("the pipeline hangs: nothing for {PATIENCE:?}"));
            }
            std::thread::sleep(Duration::from_micros(200));
        }
    }
}
