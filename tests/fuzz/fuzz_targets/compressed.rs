#![no_main]

use std::panic;

// libFuzzer's harness ends at every panic, before the reader can catch those of the decoders it calls. Those it is to catch.
libfuzzer_sys::fuzz_target!(
    init: {
        let end = panic::take_hook();
        panic::set_hook(Box::new(move |what| {
            let decoder = |path: &str| ["/zune-jpeg-", "/png-", "/tiff-", "/weezl-", "/fax-"].iter().any(|name| path.contains(name));
            if !what.location().is_some_and(|at| decoder(at.file())) {
                end(what);
            }
        }));
    },
    |data: &[u8]| storm_fuzz::targets::compressed(data)
);
