//! The shader sources, each with the shared part in front.

/// A file of `render/shaders` and its text.
pub(super) struct Shader {
    pub(super) file: &'static str,
    pub(super) source: &'static str,
}

macro_rules! shaders {
    ($($name:ident = $file:literal;)*) => {
        $(pub(super) const $name: Shader = Shader {
            file: $file,
            source: concat!(include_str!("../../shaders/common.wgsl"), "\n", include_str!(concat!("../../shaders/", $file))),
        };)*
        #[cfg(test)]
        const ALL: &[Shader] = &[$($name),*];
    };
}

shaders! {
    CHECK = "check.wgsl";
    MOTION = "motion.wgsl";
    PROJECT = "project.wgsl";
    SCAN = "scan.wgsl";
    SORT = "sort.wgsl";
    RANGES = "ranges.wgsl";
    BLEND = "blend.wgsl";
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;
    use wgpu::naga;

    fn folder() -> String {
        format!("{}/shaders", env!("CARGO_MANIFEST_DIR"))
    }

    #[test]
    fn every_shader_is_valid_without_any_adapter() {
        for shader in ALL {
            let module = naga::front::wgsl::parse_str(shader.source)
                .unwrap_or_else(|e| panic!("{}: {}", shader.file, e.emit_to_string(shader.source)));
            // No capability beyond WebGPU's own: no subgroups, no 64 bit numbers.
            let mut validator =
                naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::empty());
            validator
                .validate(&module)
                .unwrap_or_else(|e| panic!("{}: {}", shader.file, e.emit_to_string(shader.source)));
            assert!(!module.entry_points.is_empty(), "{} has no entry point", shader.file);
            for entry in &module.entry_points {
                assert_eq!(entry.stage, naga::ShaderStage::Compute, "{}", entry.name);
                assert!(entry.workgroup_size.iter().product::<u32>() <= 256, "{}", entry.name);
            }
        }
    }

    #[test]
    fn validation_would_notice_a_fault() {
        let broken = SORT.source.replace("keys_out[to] = key;", "keys_out[to] = 1.5;");
        assert_ne!(broken, SORT.source);
        let module = naga::front::wgsl::parse_str(&broken);
        let valid = module.ok().is_some_and(|m| {
            naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::empty())
                .validate(&m)
                .is_ok()
        });
        assert!(!valid);
    }

    #[test]
    fn every_file_is_used_and_opens_with_what_it_does() {
        let files: BTreeSet<String> =
            std::fs::read_dir(folder()).unwrap().map(|f| f.unwrap().file_name().into_string().unwrap()).collect();
        let used: BTreeSet<String> = ALL.iter().map(|s| s.file.to_owned()).chain(["common.wgsl".to_owned()]).collect();
        assert_eq!(files, used);
        for file in files {
            let text = std::fs::read_to_string(format!("{}/{file}", folder())).unwrap();
            let comment: Vec<&str> = text.lines().take_while(|line| line.starts_with("//")).collect();
            let comment = comment.join("\n");
            for word in ["Algorithm:", "Bindings:", "Equation"] {
                assert!(comment.contains(word), "{file} does not open with its {word}");
            }
        }
    }
}
