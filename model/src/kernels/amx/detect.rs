//! Whether this machine has the tile units, and lets this process use them.

/// Whether AMX tiles with bf16 products may be used by this process: looked up, and asked of the system, once.
pub(crate) fn available() -> bool {
    #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
    {
        static FOUND: std::sync::OnceLock<bool> = std::sync::OnceLock::new();
        *FOUND.get_or_init(|| linux::has_units() && linux::may_use())
    }
    #[cfg(not(all(target_arch = "x86_64", target_os = "linux")))]
    false
}

#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
mod linux {
    use std::arch::x86_64::{__cpuid, __cpuid_count};
    use std::ffi::c_long;

    /// Leaf 7, EDX.
    const AMX_BF16: u32 = 1 << 22;
    const AMX_TILE: u32 = 1 << 24;
    /// `asm/unistd_64.h`.
    const SYS_ARCH_PRCTL: c_long = 158;
    /// `asm/prctl.h`: asks for a state component that is not everybody's.
    const ARCH_REQ_XCOMP_PERM: c_long = 0x1023;
    /// The tiles' contents.
    const XFEATURE_XTILEDATA: c_long = 18;

    unsafe extern "C" {
        fn syscall(number: c_long, ...) -> c_long;
    }

    pub(super) fn has_units() -> bool {
        // The vector parts around the tiles want these too.
        let vectors = crate::kernels::simd::has_avx512()
            && is_x86_feature_detected!("avx512bf16")
            && is_x86_feature_detected!("avx512vnni");
        vectors && __cpuid(0).eax >= 7 && {
            let edx = __cpuid_count(7, 0).edx;
            edx & AMX_BF16 != 0 && edx & AMX_TILE != 0
        }
    }

    /// Linux saves the tiles of those processes alone that asked (5.16 and later; before it answers that it cannot).
    pub(super) fn may_use() -> bool {
        // SAFETY: a system call that takes two numbers and touches no memory of ours.
        unsafe { syscall(SYS_ARCH_PRCTL, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA) == 0 }
    }
}
