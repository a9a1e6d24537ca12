#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| storm_fuzz::targets::front(data));
