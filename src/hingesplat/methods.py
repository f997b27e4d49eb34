"""Methods of the literature as settings of our stages, so that they are compared on the same data and engine.

What they share is everything that no paper claims: depth, the single states' fits, the rasteriser, meshes.
"""

from dataclasses import replace

from hingesplat.errors import HingesplatError
from hingesplat.identity import IdentityConfig
from hingesplat.physics import PhysicsConfig, RepelConfig
from hingesplat.pipeline import MethodName, PresetName, ReconstructConfig, preset
from hingesplat.start import StartConfig


def configure(method: MethodName, preset_name: PresetName = "standard") -> ReconstructConfig:
    """A method's settings with a preset's sizes and steps.

    Raises:
        HingesplatError: no such method or preset.
    """
    config = preset(preset_name)
    match method:
        case "hingesplat":
            return config
        case "part2gs":
            return part2gs(config)
        case "artgs":
            return artgs(config)
        case "vanilla":
            return vanilla(config)
    raise HingesplatError(f"method: unknown {method!r}; use hingesplat, part2gs, artgs or vanilla")


def _without_search(config: ReconstructConfig, method: MethodName, start: StartConfig) -> ReconstructConfig:
    """Poses that start from nowhere need long strides in few steps; the paper's own number of steps gets its rate."""
    rate = 1e-3 if config.preset == "paper" else 1e-2
    return replace(
        config,
        method=method,
        start=start,
        articulate=replace(config.articulate, pose_rate=rate, frame="first" if method == "vanilla" else "between"),
        # The joint as a constraint on the last refinement is ours, and so are patches; types and standard deviations
        # are not held back.
        joints=replace(config.joints, steps=0, patches=replace(config.joints.patches, per_part=0)),
    )


def part2gs(config: ReconstructConfig) -> ReconstructConfig:
    """Part²GS as its paper has it: Hungarian matches and one β, ψ, random T_k, repel points, all losses; K given."""
    config = _without_search(config, "part2gs", StartConfig(labels="random", motions="random"))
    articulate = replace(
        config.articulate,
        identity=IdentityConfig(kind="embedding"),
        physics=PhysicsConfig(art=1.0, contact=0.5, velocity=0.5, vector=0.5, targets="matched"),
        repel=RepelConfig(points=2000, since=0.3),
    )
    return replace(config, fuse=replace(config.fuse, strategy="global"), articulate=articulate)


def artgs(config: ReconstructConfig) -> ReconstructConfig:
    """ArtGS: averaged matches, parts by Mahalanobis distance to the centres of clusters; no repulsion, no physics.

    Its chamfer distance to each state's own Gaussians, weight 100, is our L_art without the angle. Left out: its hash
    grid (a residual a Gaussian stands in), its depth loss, its separate run for joint types.
    """
    config = _without_search(config, "artgs", StartConfig(labels="clusters", motions="random", spread=0.0))
    chamfer = PhysicsConfig(art=100.0, rotation=0.0, reach=1.0, every=20)
    articulate = replace(config.articulate, identity=IdentityConfig(kind="centres"), physics=chamfer)
    return replace(config, fuse=replace(config.fuse, strategy="uniform"), articulate=articulate)


def vanilla(config: ReconstructConfig) -> ReconstructConfig:
    """No part parameters: every Gaussian moves by itself, from its match; parts are clusters of what they did."""
    config = _without_search(config, "vanilla", StartConfig(labels="random", motions="random", spread=0.0))
    articulate = replace(config.articulate, identity=IdentityConfig(kind="none"))
    return replace(config, fuse=replace(config.fuse, strategy="none"), articulate=articulate)
