//! A disk that is full for a while: the process may not make files longer than a few bytes, so the system itself refuses.

/// Files may not grow beyond this while the disk is full, bytes.
#[cfg(unix)]
const FULL_AT: u64 = 64;

/// Fills the disk, or empties it again; false where the system has no such limit.
#[cfg(unix)]
pub fn fill(full: bool) -> bool {
    let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
    // SAFETY: `limit` is a valid rlimit for the call to write to.
    if unsafe { libc::getrlimit(libc::RLIMIT_FSIZE, &raw mut limit) } != 0 {
        return false;
    }
    limit.rlim_cur = if full { FULL_AT.min(limit.rlim_max) } else { limit.rlim_max };
    // SAFETY: ignoring a signal installs no handler; without it a write beyond the limit would end the process instead of
    // failing, as it does on a full disk.
    unsafe { libc::signal(libc::SIGXFSZ, libc::SIG_IGN) };
    // SAFETY: `limit` is a valid rlimit; the soft limit stays within the hard one.
    unsafe { libc::setrlimit(libc::RLIMIT_FSIZE, &raw const limit) == 0 }
}

/// Fills the disk, or empties it again; false where the system has no such limit.
#[cfg(not(unix))]
pub fn fill(_: bool) -> bool {
    false
}
