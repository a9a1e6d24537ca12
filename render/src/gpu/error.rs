//! What can go wrong on a device.

/// The package that brings a Vulkan adapter to a machine without a GPU.
pub const SOFTWARE_ADAPTER: &str =
    "install a software adapter (Debian and Ubuntu: apt-get install mesa-vulkan-drivers)";

/// Why a device took no picture.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum GpuError {
    /// No adapter of this machine is usable, or none has the wanted name.
    #[error("no wgpu adapter{wanted}; found: {found}; {SOFTWARE_ADAPTER} or render on the CPU")]
    NoAdapter {
        /// What was asked for, as " named ..."; empty when any adapter would do.
        wanted: String,
        /// Every adapter there is and why it was not taken, or "none".
        found: String,
    },
    /// The adapter gave no device.
    #[error("{adapter} opens no device: {what}")]
    NoDevice {
        /// The adapter.
        adapter: String,
        /// The reason the driver gave.
        what: String,
    },
    /// The device is gone (driver reset, unplugged, destroyed): make a new rasteriser, or render on the CPU.
    #[error("the device {adapter} was lost: {what}; open it again or render on the CPU")]
    DeviceLost {
        /// The adapter.
        adapter: String,
        /// The reason the driver gave.
        what: String,
    },
    /// Something does not fit the device's limits.
    #[error("{name}: {value} are more than the {limit} that {adapter} can hold; render in parts or on the CPU")]
    TooLarge {
        /// What is too large.
        name: &'static str,
        /// How much of it there is.
        value: u64,
        /// How much is possible.
        limit: u64,
        /// The adapter.
        adapter: String,
    },
    /// The device refused an operation (out of memory, or a fault of this program).
    #[error("{adapter} failed: {what}")]
    Failed {
        /// The adapter.
        adapter: String,
        /// What the device said.
        what: String,
    },
}
