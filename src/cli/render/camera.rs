//! Where a picture is seen from.

use pvmap::Watch;
use pvmap::geometry::Frame;
use pvmap::render::{Lens, RenderError, Source, View};

use super::Args;
use crate::cli::Context;

/// Finds where to look from.
pub(super) fn view_of(
    args: &Args,
    splats: &dyn Source,
    frame: &Frame,
) -> Result<View, RenderError> {
    let lens = match args.ortho {
        Some(width) => Lens::Orthographic { width },
        None => Lens::Perspective { fov_deg: args.fov },
    };
    if let Some([eye, target]) = args.camera {
        let mut view = View { eye, target, up: args.up, lens };
        if args.ortho == Some(0.0) {
            let width = view.fitting_width(splats, args.size, frame)?;
            view.lens = Lens::Orthographic { width };
        }
        return Ok(view);
    }
    View::fitting(splats, args.view, args.up, lens, args.size, frame)
}

/// Says where a view that was chosen is seen from, so that it can be refined.
pub(super) fn tell(args: &Args, view: &View, context: &Context) {
    if args.camera.is_none() {
        context.progress.note(&format!("seen from here: {}", flags(view)));
    }
}

/// Gives the flags for a view.
fn flags(view: &View) -> String {
    let away = (0..3).map(|i| (view.eye[i] - view.target[i]).powi(2)).sum::<f64>().sqrt();
    // Five digits of the distance.
    let digits = (4.0 - away.log10().floor()).clamp(0.0, 12.0) as usize;
    let numbers = |v: &[f64]| {
        // Rounded first, so that nothing is -0.
        let scale = 10f64.powi(digits as i32);
        let rounded = v.iter().map(|v| (v * scale).round() / scale + 0.0);
        let each: Vec<String> = rounded.map(|v| format!("{v:.digits$}")).collect();
        each.join(",")
    };
    let mut flags = format!("--camera {}", numbers(&[view.eye, view.target].concat()));
    if view.up != [0.0, 0.0, 1.0] {
        let [x, y, z] = view.up.map(|v| v + 0.0);
        flags += &format!(" --up {x},{y},{z}");
    }
    match view.lens {
        Lens::Perspective { fov_deg } => flags += &format!(" --fov {fov_deg}"),
        Lens::Orthographic { width } => flags += &format!(" --ortho={width:.digits$}"),
    }
    flags
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flags_have_the_digits_that_matter() {
        let view = |scale: f64, lens| View {
            eye: [1.0 * scale, -2.5 * scale, -1e-9],
            target: [0.0; 3],
            up: [0.0, 0.0, 1.0],
            lens,
        };
        let eye = view(1.0, Lens::Perspective { fov_deg: 40.0 });
        assert_eq!(flags(&eye), "--camera 1.0000,-2.5000,0.0000,0.0000,0.0000,0.0000 --fov 40");
        let far = View { up: [0.0, 1.0, 0.0], ..view(1e6, Lens::Orthographic { width: 5e6 }) };
        let expected = "--camera 1000000,-2500000,0,0,0,0 --up 0,1,0 --ortho=5000000";
        assert_eq!(flags(&far), expected);
    }
}
