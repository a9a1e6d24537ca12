//! Which adapter: every one is looked at, the best usable one is taken, and it is said which.

use super::error::GpuError;
use wgpu::{Adapter, AdapterInfo, Backends, DeviceType, DownlevelFlags, Features, Instance, InstanceFlags, Limits};

/// What to open.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct GpuOptions {
    /// Part of the adapter's name, in any case; `None`: the environment's `WGPU_ADAPTER_NAME`, else the best there is.
    pub adapter_name: Option<String>,
    /// Take buffers as large as the adapter allows; without, 128 MiB, which every adapter has.
    pub large_buffers: bool,
    /// Treat bindings as no larger than this, bytes: for tests of what does not fit one, and devices that are shared.
    pub binding_bytes: Option<u64>,
}

/// An adapter and what is asked of it.
pub(super) struct Choice {
    pub(super) adapter: Adapter,
    pub(super) features: Features,
    pub(super) limits: Limits,
}

/// Name, backend, kind and driver in one line.
pub(super) fn describe(info: &AdapterInfo) -> String {
    let driver = [info.driver.as_str(), info.driver_info.as_str()].join(" ");
    format!("{} ({:?}, {:?}, {})", info.name, info.backend, info.device_type, driver.trim())
}

/// Lower is better.
fn rank(kind: DeviceType) -> u8 {
    match kind {
        DeviceType::DiscreteGpu => 0,
        DeviceType::IntegratedGpu => 1,
        DeviceType::VirtualGpu => 2,
        DeviceType::Other => 3,
        DeviceType::Cpu => 4,
    }
}

/// Why this adapter cannot be used; `None` when it can.
fn objection(adapter: &Adapter, wanted: Option<&str>) -> Option<&'static str> {
    let name = adapter.get_info().name.to_lowercase();
    if wanted.is_some_and(|part| !name.contains(&part.to_lowercase())) {
        return Some("another name is wanted");
    }
    if !adapter.get_downlevel_capabilities().flags.contains(DownlevelFlags::COMPUTE_SHADERS) {
        return Some("no compute shaders");
    }
    if !Limits::default().check_limits(&adapter.limits()) {
        return Some("below the limits of WebGPU");
    }
    None
}

/// The best usable adapter of the backends compiled in and allowed by `WGPU_BACKEND`.
pub(super) fn choose(options: &GpuOptions) -> Result<Choice, GpuError> {
    let mut description = wgpu::InstanceDescriptor::new_without_display_handle().with_env();
    // Our indirect dispatches are clamped where they are made.
    description.flags.remove(InstanceFlags::VALIDATION_INDIRECT_CALL);
    let backends = description.backends;
    let instance = Instance::new(description);
    let adapters = pollster::block_on(instance.enumerate_adapters(Backends::all()));
    let from_env = std::env::var("WGPU_ADAPTER_NAME").ok().filter(|name| !name.is_empty());
    let wanted = options.adapter_name.clone().or(from_env);
    let mut found = Vec::new();
    let mut usable = Vec::new();
    for adapter in adapters {
        match objection(&adapter, wanted.as_deref()) {
            Some(why) => found.push(format!("{}: {why}", describe(&adapter.get_info()))),
            None => usable.push(adapter),
        }
    }
    // The first of equals, as the backend lists them.
    let Some(adapter) = usable.into_iter().min_by_key(|adapter| rank(adapter.get_info().device_type)) else {
        let found = if found.is_empty() { format!("none of {backends:?}") } else { found.join(", ") };
        let wanted = wanted.map(|name| format!(" named `{name}`")).unwrap_or_default();
        return Err(GpuError::NoAdapter { wanted, found });
    };
    let mut limits = Limits::default();
    if options.large_buffers {
        let most = adapter.limits();
        limits.max_storage_buffer_binding_size = most.max_storage_buffer_binding_size;
        limits.max_buffer_size = most.max_buffer_size;
    }
    if let Some(most) = options.binding_bytes {
        limits.max_storage_buffer_binding_size = limits.max_storage_buffer_binding_size.min(most);
    }
    let features = adapter.features() & Features::TIMESTAMP_QUERY;
    Ok(Choice { adapter, features, limits })
}
