//! The open device; what it complains about outside of any call is kept and reported by the next check.

use super::adapter::{GpuOptions, choose, describe};
use super::error::GpuError;
use parking::lock;
use std::sync::{Arc, Mutex};

/// First complaint of each kind.
#[derive(Default)]
struct Complaints {
    lost: Option<String>,
    error: Option<String>,
}

/// Device, queue, and the adapter's name for messages.
pub(super) struct Gpu {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    pub(super) name: String,
    pub(super) limits: wgpu::Limits,
    /// Nanoseconds of a timestamp's unit; `None` when the adapter has no timestamps.
    pub(super) tick_ns: Option<f32>,
    complaints: Arc<Mutex<Complaints>>,
}

mod parking {
    use std::sync::{Mutex, MutexGuard, PoisonError};

    /// What the mutex guards is whole whatever a panicking holder did.
    pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
        mutex.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Gpu {
    pub(super) fn open(options: &GpuOptions) -> Result<Self, GpuError> {
        let choice = choose(options)?;
        let name = describe(&choice.adapter.get_info());
        let request = wgpu::DeviceDescriptor {
            label: Some("storm"),
            required_features: choice.features,
            required_limits: choice.limits.clone(),
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(choice.adapter.request_device(&request))
            .map_err(|e| GpuError::NoDevice { adapter: name.clone(), what: e.to_string() })?;
        let complaints = Arc::new(Mutex::new(Complaints::default()));
        let on_error = Arc::clone(&complaints);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            lock(&on_error).error.get_or_insert_with(|| error.to_string());
        }));
        let on_lost = Arc::clone(&complaints);
        device.set_device_lost_callback(move |reason, what| {
            lock(&on_lost).lost.get_or_insert_with(|| format!("{reason:?} {what}").trim_end().to_owned());
        });
        let tick_ns = choice.features.contains(wgpu::Features::TIMESTAMP_QUERY).then(|| queue.get_timestamp_period());
        Ok(Self { device, queue, name, limits: choice.limits, tick_ns, complaints })
    }

    /// Reports what the device has complained about since the last check. A lost device stays lost.
    pub(super) fn check(&self) -> Result<(), GpuError> {
        let mut complaints = lock(&self.complaints);
        if let Some(what) = &complaints.lost {
            return Err(GpuError::DeviceLost { adapter: self.name.clone(), what: what.clone() });
        }
        match complaints.error.take() {
            Some(what) => Err(self.failed(what)),
            None => Ok(()),
        }
    }

    pub(super) fn failed(&self, what: impl ToString) -> GpuError {
        // One line: the messages of wgpu are trees.
        let what = what.to_string().split_whitespace().collect::<Vec<_>>().join(" ");
        GpuError::Failed { adapter: self.name.clone(), what }
    }

    /// Refuses what is more than the limit.
    pub(super) fn fits(&self, name: &'static str, value: u64, limit: u64) -> Result<(), GpuError> {
        if value <= limit {
            return Ok(());
        }
        Err(GpuError::TooLarge { name, value, limit, adapter: self.name.clone() })
    }

    /// Most bytes of one buffer that a shader sees.
    pub(super) fn largest_binding(&self) -> u64 {
        self.limits.max_storage_buffer_binding_size.min(self.limits.max_buffer_size)
    }
}
