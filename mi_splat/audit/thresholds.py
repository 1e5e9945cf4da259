"""The numbers that a verdict depends on, each of which a record of an audit states."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """Limits, sizes and counts of an audit.

    Lengths are in radii of the object unless a unit is given.
    """

    # From where a verdict is given
    # Drift (sRGB) beyond gloss, times its share, from which a look is hidden; see
    # docs/audit.md.
    net: float = 0.0004
    suspicion: float = 0.15  # Share of that from which a splat is suspicious.
    # Support of an appearance below which it is called fog: suspicious, and never
    # hidden.
    supported: float = 0.5
    covered: float = 0.1  # Score of an occluder from which a splat is suspicious.
    # Share of it that others look through from which a repair takes it away.
    seen_through: float = 0.5
    aimed: float = 0.115  # Score from which colours are an attack on few views,
    grain: float = 0.14  # and on many.
    peaked: float = 3.0  # Peak from which a camera is named.
    # Degrees above the ground from which a direction is from above,
    steep: float = 60.0
    level: float = 15.0  # and up to which it is from the side.
    # Share of the solid Gaussians near an object from which a splat was judged whole.
    all_near: float = 0.995

    # Objects and their ground
    solid: float = 0.1  # Opacity of a Gaussian that says where things are.
    most_objects: int = 3
    # Gaussians that are linked to each other; the others go with the nearest of these.
    most_linked: int = 60_000
    # Share of the solid Gaussians that the frame is made of: those nearest to their
    # middle.
    crowd: float = 0.8
    components: int = 6  # Connected components, from the largest, that may be objects,
    least_share: float = 0.03  # with this share of the solid Gaussians,
    least_count: int = 100  # and so many of them.
    flat: float = 0.04  # Thinnest extent of a plane, by its longest.
    # Cosine between the normals of a sign and of its ground, from which it is no
    # object.
    upright: float = 0.7
    # Radius of the ball around an object, by that of what holds nearly all of it.
    object_margin: float = 1.15
    # A component inside an object is a part of it from this radius,
    part_radius: float = 0.4
    part_share: float = 0.3  # and up to this share of its Gaussians.
    # Times the radius of an object inside it from which an object is its surroundings.
    surrounds: float = 2.5
    # Share of the solid Gaussians, the smallest, that say where the core of a splat is,
    small: float = 0.2
    dense: float = 0.6  # and share of these that it holds;
    # it is judged, too, where objects without a ground are so many times larger.
    loose: float = 1.8
    ground_sample: int = 5000  # Points among which a ground is looked for,
    ground_reach: float = 4.0  # so far around, in radii,
    ground_share: float = 0.15  # with this share of them on it.
    planes: int = 2  # Planes that are tried as ground.
    touch: float = 0.4  # Radii that an object may be above its ground,
    one_side: float = 0.95  # share of it that is above the ground,
    under: float = 0.15  # but for so many radii,
    beyond: float = 1.3  # and radii that a ground reaches from its middle.
    # Radius of a whole splat, by the distance from its middle within which half of it
    # lies.
    whole_margin: float = 1.2

    # Cameras and surface
    image_size: int = 128  # Pixels along each side of an image.
    fov: float = 45.0  # Degrees.
    cameras: int = 150  # Around an object above its ground.
    cameras_all_around: int = 240  # Around an object that stands on none.
    lowest: float = 4.0  # Degrees above the ground of the lowest camera,
    highest: float = 88.0  # and of the highest.
    distance: float = 2.6  # Radii from the centre to the cameras.
    near: float = 0.02  # The near plane, as a share of that distance.
    least_views: int = 8  # Cameras that see a piece of surface that is judged.
    # Of so many cameras one takes part in saying which Gaussians carry an appearance.
    heat_every: int = 6
    # Standard deviations beyond which a Gaussian shows in no image,
    extent: float = 4.0
    faintest: float = 1 / 255  # and opacity up to which it does not.
    # A voxel that shows in fewer pixels of all images together is noise.
    least_pixels: int = 6
    opaque: float = 0.9  # Opacity of a pixel that counts,
    facing: float = 0.25  # cosine of its normal to the view,
    depth_edge: float = 0.06  # jump of depth beside it, in radii, up to which it does,
    reach: float = 2.4  # and distance from the centre, in radii.
    around: float = 1.6  # Radii around the centre in which surface is judged,
    # and height above the foot of an object, in radii, above which it is no ground.
    above: float = 0.1
    # Length of the mean normal below which a piece is an edge, which is not judged.
    agreed: float = 0.9
    # Cosine between neighbours below which both are a rim, where colours of several
    # sides mix.
    across: float = 0.3

    # Rooms
    # Radii from the middle of an object to the nearest camera in a room.
    room_distance: float = 1.3
    # Half the field of view, by the angle at which the object is seen.
    room_margin: float = 1.2
    least_room_cameras: int = 12
    most_room_cameras: int = 120

    # Verdicts on objects
    least_pieces: int = 60  # Pieces of surface of a splat that gets a verdict.
    least_cameras: int = 12  # Cameras that have to be given,
    most_cameras: int = 300  # and that are used of those given.
    # Pixels along the longer side of an image from a given camera in a room.
    given_size: int = 256
    # Degrees from a given camera, seen from an object, within which cameras look at it,
    given_near: float = 6.0
    given_lattice: int = 1200  # of so many directions all around.
    changed: float = 0.05  # Score from which a piece of surface counts as changed.
    # Share of the surface that a look from given cameras changes if it fully counts.
    changed_share: float = 0.015
    # Gaussians, evenly taken, of which is asked whether cameras looked at them.
    near_sample: int = 5000
    most_looks: int = 3
    # Cosine between changes of colour, piece by piece, from which two cameras see one
    # look.
    same_look: float = 0.7
    # Degrees beyond the cameras of an appearance that are left out with it.
    look_edge: float = 20.0
    # Drift of another appearance by that of the first, from which it is no ripple of
    # it.
    another_look: float = 0.4
    # Power of the amounts of an appearance by which cameras attract the axis of its
    # region.
    attraction: int = 3
    # Share of the cameras that has to be left to look for another appearance.
    cameras_left: float = 1 / 3

    # Sets of directions, and gloss
    # Length of the mean of the directions to a piece from which nothing contradicts it.
    one_sided: float = 0.95
    noise: float = 0.03  # sRGB by which clean surface may differ from camera to camera.
    # Cameras on each side of an appearance that have to see a piece of surface.
    least_seen: int = 3
    # Rounds in which a profile over directions and the amounts of pieces are fitted in
    # turn,
    profile_rounds: int = 8
    profile_width: float = 12.0  # degrees over which it is smooth,
    profile_pieces: int = 1200  # pieces that it is fitted to,
    profile_places: int = 150  # mirrored directions
    profile_angles: int = 12  # and angles of incidence that it is compared with.

    # Support: do both sides of an appearance see the same surface through clear air?
    # Radii between mean and median depth up to which a ray ends in one place,
    one_place: float = 0.1
    solid_ray: float = 0.85  # from this opacity.
    empty_ray: float = 0.08  # Opacity up to which a ray meets nothing.
    towards: float = 0.35  # Cosine from which a piece of surface faces a camera.
    # Share of the cameras that it faces which see a piece of surface well,
    well_seen: float = 0.3
    # and share of that from which the other side sees it, too.
    hardly_seen: float = 0.1
    # Share of such surface lost, from full support to none.
    lost: tuple[float, float] = (0.45, 0.55)
    # Clear rays of the side that has fewer by those of the other, likewise.
    as_clear: tuple[float, float] = (0.8, 0.6)

    # Roofs beyond the cameras
    far_cameras: int = 40
    # Degrees above the ground: below, a sky covers an object, too.
    far_lowest: float = 20.0
    far_size: int = 48  # Pixels.
    far_distances: tuple[float, float] = (6.0, 10.0)  # Radii.
    # Share of the rays to the object that end before it, from which it is covered,
    far_blocked: float = 0.5
    roof: float = 2.3  # so many radii off,
    roof_spread: float = 0.25  # with no more deviation of their distances, by the mean.
    # Share of the pairs of a covered and a clear camera in which the covered one is
    # higher.
    roof_higher: float = 0.9

    # Occluders and heat
    # Share of the rays to the object that end before it, from which a camera is
    # blocked,
    blocked: float = 0.3
    free: float = 0.1  # and up to which it is free.
    core: float = 0.5  # Radii within which a ray passes the centre that counts.
    air: float = 1.15  # Radii from the centre where air begins,
    floor: float = 0.15  # and above the ground.
    # Radii around a Gaussian of the object within which it is the object itself that
    # covers it.
    own_part: float = 0.1
    same_depth: float = 0.15  # Radii by which equal depths may differ.
    cover_points: int = 60  # Kept of each blocked image.
    # Views of them from free cameras without which nothing is said.
    least_cover_points: int = 200
    pair_pieces: int = 800  # Of the highest score, by which two cameras are chosen.
    bins: int = 128  # Of the histogram by which heat is split.
    # Pixels that a Gaussian makes up at least to have heat of the surface.
    least_weight: float = 1e-3
    # On each side of an appearance, and of those that see what covers.
    heat_cameras: int = 16
    cover_heat: float = 0.2  # Heat of what covers an object,
    # and pixels of it that a Gaussian makes up to have half of that.
    cover_pixels: float = 1.0

    # Edits of colours
    # Gaussians from which shares mean anything, of the object and of each shell.
    least_edited: int = 50
    shells: int = 8  # Around an object, of equal numbers.
    shell_gaussians: int = 16_000  # In all shells together.
    edit_gaussians: int = 32_000  # Of an object; a larger one is seen in slabs
    slab: int = 4_000  # of so many that lie together.
    least_sh: float = 0.003  # Root mean square of coefficients that nobody sees.
    least_colour: float = 0.001  # Difference of colours (sRGB) that nobody sees.
    grain_neighbours: int = 8  # That a colour is compared with,
    alike: float = 0.8  # where normals have this cosine,
    least_neighbours: int = 3  # and there are so many.
    strongest: int = 1500  # Gaussians that say where the camera stood.
    # Radii from the middle to the places that are tried.
    edit_distances: tuple[float, ...] = (2.0, 3.5)
    edit_directions: int = 600  # That are tried.

    # Repair
    # Degrees off the others; the first that leaves,
    margins: tuple[float, ...] = (25.0, 20.0, 15.0, 10.0, 5.0, 0.0)
    believed_share: float = 0.15  # this share of them,
    believed_cameras: int = 6  # and so many.
    # Of a direction within the margin, where only such directions show a Gaussian.
    margin_weight: float = 0.002
    lending: int = 16  # Neighbours that lend their colour,
    # and their weight, as a share of what a Gaussian shows of itself elsewhere.
    borrowed: float = 0.1
    strict: float = 3.0  # Weight of the wanted colours by that of the kept ones.
    ridge: float = 1e-2  # Weight of coefficients above degree 0 against all colours.
    # Towards all believed directions, that a Gaussian makes up to be coloured anew.
    repaired_pixels: float = 0.01

    # Comparison with a clean file
    # Distance within which a Gaussian is in its place, in the spacing of the clean
    # splat,
    unmoved: float = 0.1
    partner: float = 0.5  # and within which it may have a partner.
    # Of the smaller splat that has to be in its place for one to be made from the
    # other.
    same_share: float = 0.5
    candidates: int = 8  # Neighbours among which a partner is looked for.
    spacing: int = 3  # The neighbour whose distance is the spacing.
    # Differences that files round away, of positions in the spacing.
    rounding: float = 1e-5
    # Times the median from which a difference is masked, where every Gaussian differs.
    more_changed: float = 4.0
    changed_margin: float = 1.2  # Radius of what is looked at, by that of what changed.
    worst_size: int = 48  # Pixels of images that choose the worst cameras,
    worst_every: int = 5  # of which every so many is tried.
    worst_cameras: int = 2  # That are shown,
    worst_width: int = 384  # so wide.


LIMITS = Thresholds()
