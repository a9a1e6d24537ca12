//! The one configuration struct: its fields are the YAML schema, the defaults, the ROS parameters and the documentation.
//!
//! Each section is written with `section!`, which keeps a field's doc comment as the text `storm config` and the README
//! table print. Unknown keys are refused; every value is checked by [`Config::validate`].

mod docs;
mod file;
mod nearest;
mod parameters;
mod rectified;
mod section;
mod validate;

pub use file::ConfigError;
pub(crate) use file::nests_too_deep;
pub use parameters::RUN_TIME;
pub use rectified::RectifiedSetting;
pub use section::ParameterDoc;
use section::section;
use serde::{Deserialize, Serialize};

section! {
    /// Topics and frames.
    pub struct InputConfig {
        /// Image topics, one per camera, in the network's order (left to right); empty: found by type.
        images: Vec<String> = Vec::new(),
        /// CameraInfo topics in the same order; empty: the one beside each image topic.
        camera_infos: Vec<String> = Vec::new(),
        /// Pose topic (PoseStamped, PoseWithCovarianceStamped, Odometry, TransformStamped or TFMessage); empty: found by type.
        pose: String = String::new(),
        /// Fixed frame of the outputs; empty: the frame the pose message is given in, with TF `map`, else `odom`, else the tree's root. Another frame than the pose's must be connected to it by /tf.
        map_frame: String = String::new(),
        /// Vehicle frame; empty: the pose message's child frame, else `base_link`.
        base_frame: String = String::new(),
        /// Camera mounting, one entry per camera: x y z (m) then qw qx qy qz, optical frame in the vehicle frame; empty: from /tf_static, /tf (joints) or P (stereo); the camera's own frame where the pose is of it.
        base_from_camera: Vec<[f64; 7]> = Vec::new(),
        /// Camera the window is anchored at; -1: the one that looks most nearly along the vehicle's x axis.
        reference_camera: i64 = -1,
        /// Which stamps count: `header` (the messages' own), `recorded` (when the recording got each message; live, when it came in), for headers that are not filled in or of two clocks.
        stamps: String = "header".into(),
        /// Constant added to each camera's stamps, seconds; empty: none.
        image_time_offset_sec: Vec<f64> = Vec::new(),
        /// Whether images are rectified already: `auto` (the last part of the topic's name says so, else the CameraInfo), `true`, `false`; or a list with one of them per camera.
        rectified: RectifiedSetting = RectifiedSetting::default(),
        /// Parts of images to ignore, such as the vehicle's own bonnet: entries `CAMERA=FILE` with the camera's number or image topic and a picture of any size, black where to ignore.
        masks: Vec<String> = Vec::new(),
        /// Whether a constant black frame around a camera's images (left by a driver's own rectification, or around a fisheye's circle) is looked for and left out.
        find_black_frame: bool = true,
        /// Topics below this prefix are ground truth: never input, used for scoring.
        truth_prefix: String = "/ground_truth".into(),
    }
}

section! {
    /// How images and poses are brought together.
    pub struct SyncConfig {
        /// Largest distance of an image's stamp from the set's reference stamp, seconds.
        slop_sec: f64 = 0.02,
        /// How long an image waits for the other cameras' after it came in, seconds of message time.
        timeout_sec: f64 = 0.25,
        /// How long a set waits for a pose after its newest image, seconds of message time.
        pose_wait_sec: f64 = 0.5,
        /// Largest gap between two poses that is still interpolated across, seconds; poses that come slower are followed up to 2 s.
        pose_gap_sec: f64 = 0.5,
        /// Most images of one camera that wait for the others; the oldest is dropped beyond it.
        max_pending: usize = 64,
        /// After this long without a set the starvation report is given, seconds.
        starvation_sec: f64 = 5.0,
        /// A stamp that goes back by more than this is a clock jump: window and sync start anew, seconds.
        jump_back_sec: f64 = 1.0,
        /// A stamp that goes forward by more than this is a clock jump, seconds.
        jump_forward_sec: f64 = 10.0,
    }
}

section! {
    /// The sliding window.
    pub struct WindowConfig {
        /// Timesteps the network sees, 1 to 10.
        timesteps: usize = 4,
        /// Time between them, seconds.
        stride_sec: f64 = 0.5,
        /// Least time between two steps, seconds; 0: a step at every new synchronized set.
        hop_sec: f64 = 0.0,
        /// Largest distance of a set from its place in the window, as a part of the stride.
        stride_tolerance: f64 = 0.25,
        /// Time the network's clock is divided by, seconds (the training's clip length).
        timespan_sec: f64 = 2.0,
    }
}

section! {
    /// The network.
    pub struct ModelConfigSection {
        /// Weights file (.safetensors, .pth, .pt); empty: the weights that ship (preset `tiny`), seeded random ones for other presets; `untrained`: seeded random ones.
        weights: String = String::new(),
        /// Architecture when there is no weights file: tiny, base, b8, l8, xl8, h8, b16, l16, h16.
        preset: String = "tiny".into(),
        /// Seed of the random weights used without a weights file.
        untrained_seed: u64 = 1,
        /// Where it runs: cpu, cuda, metal.
        device: String = "cpu".into(),
        /// Picture width the network sees, pixels, a multiple of the patch; 0: what the weights were made for.
        image_width: usize = 0,
        /// Picture height the network sees, pixels, a multiple of the patch; 0: what the weights were made for.
        image_height: usize = 0,
        /// Threads for the network and the rasteriser; 0: all cores.
        threads: usize = 0,
        /// How long before each timestep the network's velocity sweep has one more image, seconds (networks with `sweep_after_block`); 0: none. Where images come too seldom there is none.
        sweep_prior_sec: f64 = 0.1,
        /// Numbers of the transformer's products: `f32`, `int16` (whole numbers with exact sums), `int8` (the same, weights in 8 bits), `bf16` (operands rounded to bf16: fastest where the processor has AMX tile units, elsewhere no faster than `f32`). On a CPU; elsewhere as they are.
        precision: String = "f32".into(),
    }
}

section! {
    /// Skipping what a scene does not need.
    pub struct SkipConfig {
        /// A window that shows what the last computed one showed takes its result: all cameras where they were, all pictures the same up to noise.
        still: bool = true,
        /// A camera may be this far from where it was and still count as standing, metres.
        still_m: f64 = 0.02,
        /// And turned by this much, degrees.
        still_deg: f64 = 0.05,
        /// And its timesteps lie apart by this much more or less, seconds.
        still_sec: f64 = 0.03,
        /// A patch of 4x4 pixels has changed when its mean is off by more than this many standard deviations of the pictures' noise,
        still_sigmas: f64 = 6.0,
        /// and by more than this many 8-bit levels.
        still_levels: f64 = 1.5,
        /// A window that the last computed Gaussians, moved by their velocities, explain in every patch of the newest pictures takes them, extrapolated.
        predict: bool = false,
        /// Farthest ahead of the last computed step, seconds.
        predict_sec: f64 = 0.5,
        /// Farthest a camera may have moved since, metres.
        predict_m: f64 = 10.0,
        /// And turned, degrees.
        predict_deg: f64 = 10.0,
        /// A patch is unexplained when picture less prediction has changed by more than noise, by more than this many 8-bit levels,
        predict_levels: f64 = 4.0,
        /// and by more than the picture changes within this many pixels.
        predict_px: f64 = 1.0,
        /// After this many skipped or approximated steps one is computed in full all the same and compared; 0: nothing is skipped.
        check_every: usize = 100,
        /// Most PSNR such a step may lose against the full one, dB; beyond it the level goes down a notch until a check holds again.
        max_psnr_loss_db: f64 = 0.1,
        /// Largest difference of velocities, as a part of the speeds seen.
        max_flow_change: f64 = 0.02,
        /// Largest part of the moving pixels in which the two differ.
        max_mask_change: f64 = 0.01,
        /// In the middle blocks the keys and values of so many times so many patches of a picture are taken as one, 1 to 4; 1: off.
        kv_pool: usize = 1,
        /// Part of the image tokens merged into a neighbour of the same picture, 0 to 0.75; edges and what moves are kept longest. 0: off.
        merge: f64 = 0.0,
        /// The last block and the heads work on the newest timestep alone: results are those of all, but only its Gaussians are there for the map and for drawing other times.
        newest_only: bool = false,
        /// Windows in a row that compute their newest timestep alone and take the older ones, keys, values and Gaussians, from the window one stride before, in its frame; then one is computed in full. 0: off. `--anchor-lead` trains weights for it.
        reuse: usize = 0,
        /// Patches that were sky when last computed, far from anything else, and look the same are not computed (one window at a time: not with `--batch`).
        sky: bool = false,
        /// A patch is sky when no pixel of it was more opaque than this.
        sky_opacity: f64 = 0.05,
        /// After this many steps with patches left out, all are computed.
        sky_every: usize = 10,
    }
}

section! {
    /// What overlapping windows say of each other.
    pub struct OverlapConfig {
        /// Whether the velocity of surfaces is taken away that the window's other pictures show standing where they are.
        enabled: bool = true,
        /// Depths in two pictures are the same surface when they differ by less than this part of the depth; more where the network's own predictions of one pixel differ by more.
        depth_gate: f64 = 0.03,
        /// Largest difference of colour (root mean square over the channels, 0 to 1) between two looks at one surface.
        max_color_step: f64 = 0.2,
    }
}

section! {
    /// The long-horizon map.
    pub struct MapConfig {
        /// Edge of the tiles the map is kept, put to disk and published in, metres.
        tile_m: f64 = 16.0,
        /// Edge of the finest merging voxels, metres; farther away, where pixels are larger, voxels are 2, 4, 8 or 16 times that.
        voxel_m: f64 = 0.1,
        /// Two depths along one ray are the same surface when they differ by less than this part of the distance.
        depth_gate: f64 = 0.02,
        /// Gaussians faster than this do not enter the map, m/s.
        static_speed_mps: f64 = 1.0,
        /// A motion group with more than this part of its Gaussians faster than that does not enter either.
        moving_group_share: f64 = 0.5,
        /// Gaussians less opaque than this do not enter the map.
        min_opacity: f64 = 0.1,
        /// Gaussians farther than this from their own camera do not enter the map, metres.
        max_depth_m: f64 = 60.0,
        /// Surfaces that later rays pass clearly through leave the map.
        free_space: bool = true,
        /// Hard cap on map Gaussians in memory; far tiles go to disk, and without `map.spill` the least confident Gaussians go.
        max_gaussians: usize = 4_000_000,
        /// Hard cap on the map's memory, MiB.
        max_mb: usize = 512,
        /// Whether far tiles may go to disk (`map/` in the results folder) and come back with the vehicle.
        spill: bool = true,
        /// Hard cap on the map's files, MiB; beyond it nothing more goes to disk.
        max_disk_mb: usize = 16_384,
        /// The map is saved this often, seconds; a killed run loses at most that much. 0: only at the end.
        save_every_sec: f64 = 10.0,
        /// Whether a save waits until it is on the disk itself, so that it outlives a loss of power too (a killed run needs no waiting).
        sync: bool = true,
        /// Folder of a saved map (`map/` of a results folder) to go on from; it is copied, not changed. Empty: start anew.
        load: String = String::new(),
        /// Most Gaussians in map.ply and the published map; a larger map is thinned out evenly there, never in `map/`. 0: no limit.
        max_written: usize = 5_000_000,
    }
}

section! {
    /// Point trajectories.
    pub struct TracksConfig {
        /// Gaussians slower than this start no trajectory, m/s.
        min_speed_mps: f64 = 1.0,
        /// Gaussians less opaque than this start no trajectory.
        min_opacity: f64 = 0.3,
        /// A trajectory continues at the nearest Gaussian within this distance of its predicted place, metres; more where its speed is uncertain or it is far away.
        gate_m: f64 = 0.5,
        /// Added to the gate per metre of distance from the camera, metres.
        gate_per_m: f64 = 0.01,
        /// Largest gate, metres.
        max_gate_m: f64 = 2.0,
        /// Largest difference of colour (root mean square over the channels, 0 to 1) between a trajectory and the Gaussian that continues it.
        max_color_step: f64 = 0.25,
        /// A trajectory without a Gaussian near its predicted place for longer than this ends, seconds.
        bridge_sec: f64 = 0.6,
        /// New trajectories start at least this far from all others, metres.
        spacing_m: f64 = 0.5,
        /// Trajectories shorter than this many points are not written.
        min_points: usize = 3,
        /// Most trajectories kept alive at once.
        max_active: usize = 20_000,
    }
}

section! {
    /// Moving objects.
    pub struct ObjectsConfig {
        /// Moving Gaussians nearer than this to each other may belong to one object, metres.
        connect_m: f64 = 0.6,
        /// Neighbouring Gaussians whose velocities differ by less than this do (twice as much within a motion group), m/s.
        velocity_step_mps: f64 = 1.5,
        /// Fewest Gaussians of an object in one step.
        min_points: usize = 5,
        /// An object continues at a group within this distance of its predicted place plus half its size, metres.
        gate_m: f64 = 1.0,
        /// And with a velocity that differs by less than this, m/s.
        velocity_gate_mps: f64 = 4.0,
        /// An object that is not seen for longer than this ends, seconds.
        bridge_sec: f64 = 1.0,
        /// Steps after which an object is believed.
        confirm_steps: usize = 3,
        /// Most objects at once.
        max_objects: usize = 500,
        /// Edge of the voxels its Gaussians are merged in, metres.
        voxel_m: f64 = 0.1,
    }
}

section! {
    /// What is written.
    pub struct OutputConfig {
        /// Write outputs.mcap, the topics the node would have published.
        bag: bool = true,
        /// Gaussians less opaque than this are not published (1/255 is what a picture can show).
        min_opacity: f64 = 0.00392156862745098,
        /// Most Gaussians in one published cloud; the least opaque are left out and counted. 0: no limit.
        max_gaussians: usize = 0,
        /// Least time between two messages of changed map tiles in outputs.mcap, seconds; 0: only the whole map at the end.
        map_every_sec: f64 = 1.0,
        /// Most in one of them, MiB; what is left waits for the next.
        map_max_mb: f64 = 8.0,
        /// Steps shown in report.html, evenly spread.
        report_steps: usize = 8,
        /// Render frames that are not context at their own time and pose and score them.
        score_held_out: bool = true,
        /// Most held-out frames scored per step; they are spread over the window.
        score_frames_per_step: usize = 2,
    }
}

section! {
    /// The live node.
    pub struct LiveConfig {
        /// Cameras that must be there before `storm node` starts; 0: those there are when the topics have been the same for 2 s.
        cameras: usize = 0,
        /// Which pictures to take where a camera offers both: `auto` (raw), `raw`, `compressed`.
        transport: String = "auto".into(),
        /// What pictures and poses are asked for with: `sensor_data` (best effort, matches every publisher) or `reliable`.
        reliability: String = "sensor_data".into(),
        /// Pictures of one camera that may wait to be decoded, and again to be used; the oldest goes first.
        queue: usize = 20,
        /// A camera or the pose that sends nothing for longer than this has stopped, seconds.
        silence_sec: f64 = 1.0,
        /// Whether the node goes on with the cameras that are left when one stops.
        degrade: bool = true,
        /// When the map is kept: `auto` (from when somebody first listens to it; always with a `map_dir`), `always`, `never`.
        map: String = "auto".into(),
        /// Folder the map is kept and saved in; empty: it lives in memory alone.
        map_dir: String = String::new(),
        /// Least time between two messages of the map, seconds.
        map_every_sec: f64 = 1.0,
        /// Most in one message of the map, MiB: the whole map is thinned out evenly, changed tiles wait for the next message.
        map_max_mb: f64 = 8.0,
    }
}

impl WindowConfig {
    /// Time from the first timestep of a window to the last, seconds.
    pub fn span_sec(&self) -> f64 {
        self.stride_sec * self.timesteps.saturating_sub(1) as f64
    }
}

/// The whole configuration.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Topics and frames.
    pub input: InputConfig,
    /// How images and poses are brought together.
    pub sync: SyncConfig,
    /// The sliding window.
    pub window: WindowConfig,
    /// The network.
    pub model: ModelConfigSection,
    /// Skipping what a scene does not need.
    pub skip: SkipConfig,
    /// What overlapping windows say of each other.
    pub overlap: OverlapConfig,
    /// The long-horizon map.
    pub map: MapConfig,
    /// Point trajectories.
    pub tracks: TracksConfig,
    /// Moving objects.
    pub objects: ObjectsConfig,
    /// What is written.
    pub output: OutputConfig,
    /// The live node.
    pub live: LiveConfig,
}

impl Config {
    /// Every parameter with its dotted name, default and description, in the order of the file.
    pub fn describe() -> Vec<ParameterDoc> {
        let mut docs = Vec::new();
        docs.extend(InputConfig::describe("input"));
        docs.extend(SyncConfig::describe("sync"));
        docs.extend(WindowConfig::describe("window"));
        docs.extend(ModelConfigSection::describe("model"));
        docs.extend(SkipConfig::describe("skip"));
        docs.extend(OverlapConfig::describe("overlap"));
        docs.extend(MapConfig::describe("map"));
        docs.extend(TracksConfig::describe("tracks"));
        docs.extend(ObjectsConfig::describe("objects"));
        docs.extend(OutputConfig::describe("output"));
        docs.extend(LiveConfig::describe("live"));
        docs
    }
}
