"""All commands of `amers`: noun, then verb, and the function behind each."""

from amers.app.cli.on_demand import Command, Group, Tree

COMMANDS: Tree = {
    "block": Group(
        "Blocks of control points: ingest, publish, withdraw, delete, export.",
        {
            "ingest": Command(
                "block_ingestion:ingest",
                "Check a block folder completely and load it into the store, staged.",
            ),
            "list": Command("block_listing:list_blocks", "List all blocks, the newest first."),
            "show": Command("block_detail:show_block", "Show one block."),
            "publish": Command(
                "block_state:publish",
                "Publish a block, and withdraw the version of it that was published before.",
            ),
            "restore": Command(
                "block_state:restore",
                "Publish a withdrawn or superseded block again, in place of its published version.",
            ),
            "prioritise": Command(
                "block_state:prioritise",
                "Set the priority of a block: where blocks overlap, the block with the higher "
                "one is served.",
            ),
            "withdraw": Command(
                "block_state:withdraw", "Withdraw a published block; it can be restored."
            ),
            "delete": Command(
                "block_deletion:delete",
                "Delete a block that is not published, permanently; its chip files go into the trash.",
            ),
            "export": Command(
                "block_export:export",
                "Write the served points of a box, with their chips, into a new block folder.",
            ),
            "quality": Command(
                "block_quality:quality",
                "Measure the quality of a block: density, and accuracy against ortho-images and "
                "heights.",
            ),
            "renew": Command(
                "block_renewal:renew",
                "Stage a new version of a block: add views of registered scenes and points, "
                "remove vanished points.",
            ),
            "frame": Command(
                "block_frame:frame",
                "Move a block onto control that became available later; its points and chips stay "
                "unchanged.",
            ),
        },
    ),
    "base": Group(
        "Bases of control points for any region, from open archives of images.",
        {
            "make": Command(
                "base:make",
                "Make a base of control points for a region from an open archive of images.",
            ),
            "update": Command(
                "base:update",
                "Make the next version of a base: add views of new dates, remove vanished "
                "points, fill gaps.",
            ),
        },
    ),
    "points": Group(
        "Points: those of published blocks, and ground coordinates of marks in images.",
        {
            "intersect": Command(
                "point_intersection:intersect",
                "Compute ground coordinates, with their accuracy, of points that are marked in several "
                "images.",
            ),
            "experiment": Command(
                "point_experiment:experiment",
                "Measure errors of marked points by the number of control points, the images and their "
                "base.",
            ),
            "reach": Command(
                "site_reach:reach",
                "Measure how far the effect of each known site reaches when it is the only control.",
            ),
            "query": Command(
                "point_query:query",
                "Write all points of a box; --json without --output prints only their number.",
            ),
            "suspensions": Command(
                "points:suspensions",
                "List points proposed for suspension because many scenes do not find them, worst first.",
            ),
            "suspend": Command(
                "points:suspend",
                "Suspend a point: registrations do not use it, and readers do not get it.",
            ),
            "reinstate": Command(
                "points:reinstate",
                "Serve a suspended point again, with a new, empty history.",
            ),
        },
    ),
    "scene": Group(
        "Register and orthorectify scenes.",
        {
            "register": Command(
                "scene:register",
                "Refine the sensor models of scenes on control points; write report, points and "
                "refined models.",
            ),
            "register-many": Command(
                "scenes_together:register_many",
                "Refine the models of scenes in one adjustment, on control points and tie points "
                "between them.",
            ),
            "ortho": Command(
                "scene_ortho:ortho",
                "Orthorectify a scene through its model and a terrain into a cloud-optimised GeoTIFF.",
            ),
            "straighten": Command(
                "scene_straighten:straighten",
                "Resample a registered scene with displaced lines or samples, so that an RPC "
                "fits its model.",
            ),
            "mosaic": Command(
                "scene_mosaic:mosaic",
                "Make an ortho-image of scenes, cut where they agree best; measure the steps at seams.",
            ),
        },
    ),
    "surface": Group(
        "Surfaces: heights of the ground and of what stands on it.",
        {
            "make": Command(
                "surface:make",
                "Make the surface that overlapping registered scenes show: heights with their accuracy, "
                "on a map.",
            ),
            "points": Command(
                "surface:points",
                "Write the cells of a surface as a point cloud, for CloudCompare and QGIS.",
            ),
            "difference": Command(
                "surface:difference",
                "Compare two surfaces: what rose and what sank, with its accuracy, on a map.",
            ),
        },
    ),
    "vectors": Group(
        "Vectors digitised on raw scenes, onto the map and back.",
        {
            "canvas": Command(
                "vector_canvas:canvas",
                "Write a view of a raw scene without georeferencing, for drawing on its pixels in QGIS.",
            ),
            "correct": Command(
                "vectors:correct",
                "Transform vectors drawn on a raw scene to the map, with their predicted accuracy.",
            ),
            "project": Command(
                "vectors:project",
                "Transform vectors of the map to pixel coordinates of a raw scene.",
            ),
        },
    ),
    "reference": Group(
        "Reference images, for scenes on ground without control points.",
        {
            "add": Command("reference:add", "Add a reference image that scenes can be registered on."),
            "list": Command("reference:list_references", "List the reference images, by name."),
            "remove": Command(
                "reference:remove",
                "Remove a reference image from the installation; its files stay in their folder.",
            ),
        },
    ),
    "production": Group(
        "Make new blocks of points from images.",
        {
            "select": Command(
                "image_selection:select",
                "Choose the fewest recent, clear and varied images that show all ground often enough.",
            ),
            "plan": Command(
                "planning:plan",
                "Predict the accuracy of a block, and find the place where one more known site helps "
                "most.",
            ),
            "run": Command(
                "image_production:run",
                "Make control points with chips from two or more overlapping images.",
            ),
            "points": Command(
                "production_points:points",
                "Make a block from the points of another base, with chips of that base or from "
                "your images.",
            ),
            "ortho": Command(
                "production_ortho:ortho",
                "Make control points with chips from ortho-images of one place and the heights of its "
                "ground.",
            ),
        },
    ),
    "db": Group(
        "The database: schema, backup and restore with the stored files.",
        {
            "upgrade": Command(
                "db:upgrade",
                "Upgrade the schema of the database to the version that this Amers needs.",
            ),
            "status": Command(
                "db:status",
                "Show the schema version of the database and the one that this Amers needs.",
            ),
            "backup": Command(
                "db_backup:backup",
                "Write the database and the stored files into a folder, as one set with a manifest.",
            ),
            "verify-backup": Command(
                "db_backup:verify_backup",
                "Read a backup and compare it with its manifest: missing, surplus and changed files.",
            ),
            "restore": Command(
                "db_backup:restore",
                "Verify a backup, and restore it into an empty database and an empty storage.",
            ),
        },
    ),
    "store": Group(
        "The storage of the files: verify, usage, adopt, sweep, trash.",
        {
            "adopt": Command(
                "store:adopt",
                "Bind the storage to the database, after you have checked that they belong together.",
            ),
            "usage": Command(
                "store:show_usage",
                "Show the storage that every owner uses, and files without an owner.",
            ),
            "sweep": Command(
                "store:sweep",
                "Move all files that no row of the database names into the trash, without a limit.",
            ),
            "verify": Command(
                "store:verify",
                "Read every file and report rotten, missing and unknown files; exit code 1 if "
                "there are any.",
            ),
            "trash": Group(
                "Files that the sweep removed.",
                {
                    "list": Command(
                        "store_trash:list_trash", "List the files in the trash, oldest first."
                    ),
                    "restore": Command(
                        "store_trash:restore",
                        "Move the files of a batch back, except files whose place is occupied.",
                    ),
                    "empty": Command("store_trash:empty", "Delete all files in the trash."),
                },
            ),
        },
    ),
    "token": Group(
        "Tokens of the callers of the API.",
        {
            "create": Command(
                "token:create", "Create a token and print its secret, which is shown only once."
            ),
            "list": Command("token:list_tokens", "List all tokens, the newest first."),
            "revoke": Command("token:revoke", "Revoke a token: requests with its secret are refused."),
        },
    ),
    "demo": Command(
        "demo:demo",
        "Run all steps on a simulated world: images, block, store, registration, report.",
    ),
    "serve": Command("serve:serve", "Run the API and one worker until Ctrl-C."),
    "worker": Command("worker:worker", "Run the jobs of the queue, one after another, until Ctrl-C."),
    "audit": Command(
        "audit:audit",
        "Show the last changes of tokens, blocks, scenes, jobs and points, the newest first.",
    ),
    "doctor": Command(
        "doctor:doctor",
        "Check this installation: versions, database, storage, map page, geoid grids, disk space.",
    ),
}
"""Groups and single commands in the order of the help; a test compares the lines with the docstrings."""
