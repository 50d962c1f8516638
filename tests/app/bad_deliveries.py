"""Bad requests about scenes, uploads, blocks and tokens; all must be refused."""

from base64 import b64encode

from tests.app.bad_requests import HUGE, ITEMS, NO_ID, Bad
from tests.app.hostile_installation import LIMIT_BYTES

TUS = {"Tus-Resumable": "1.0.0"}
PIECE = {**TUS, "Content-Type": "application/offset+octet-stream"}
TIFF = b"II*\0" + bytes(1000)


def begun(name: str, says: str, length: str = "100", who: str = "register", **metadata: str) -> Bad:
    headers = {**TUS, "Upload-Length": length}
    return Bad(f"tus {name}", "POST", "/uploads", says, who, headers=headers, metadata=metadata)


def sent(
    name: str,
    says: str,
    content: bytes = b"x",
    upload: str = "<own_upload>",
    who: str = "register",
    **headers: str,
) -> Bad:
    named = {key.replace("_", "-"): value for key, value in headers.items()}
    return Bad(
        f"tus piece {name}",
        "PATCH",
        f"/uploads/{upload}",
        says,
        who,
        content=content,
        headers={**PIECE, **named},
    )


def scene(
    name: str,
    says: str,
    query: str = "name=a.tif",
    content: bytes = TIFF,
    who: str = "register",
    **headers: str,
) -> Bad:
    named = {key.replace("_", "-"): value for key, value in headers.items()}
    return Bad(f"scene {name}", "POST", f"/scenes?{query}", says, who, content=content, headers=named)


def called(name: str, authorization: str, says: str = "oken") -> Bad:
    return Bad(
        f"token {name}", "GET", "/jobs", says, "nobody", 401, headers={"Authorization": authorization}
    )


SCENES = [
    scene("without a name", "name", ""),
    scene("with a name of dots", "name", "name=.."),
    scene("with a name of folders only", "name", "name=../../"),
    scene("with a name of NUL", "name", "name=%00"),
    scene("that is a VRT", "neither TIFF", content=b'<VRTDataset rasterXSize="1"></VRTDataset>'),
    scene("that is an archive", "neither TIFF", content=b"PK\3\4" + bytes(100)),
    scene("that is a page", "neither TIFF", content=b"<html><script>alert(1)</script></html>"),
    scene("that is a program", "neither TIFF", content=b"\x7fELF" + bytes(100)),
    scene("that is HDF", "neither TIFF", content=b"\x89HDF\r\n\x1a\n" + bytes(100)),
    scene("that is a list of WMS", "neither TIFF", content=b"<GDAL_WMS><Service/></GDAL_WMS>"),
    scene("that is empty", "neither TIFF", content=b""),
    scene("of three bytes", "neither TIFF", content=b"II*"),
    scene("with a wrong checksum", "sha256", X_Checksum="0" * 64),
    scene("with a checksum that is none", "X-Checksum", X_Checksum="zz"),
    scene("with a digest that is none", "Repr-Digest", Repr_Digest="sha-256=:AAAA:"),
    scene("with a negative accuracy", "sigma_m", "name=a.tif&sigma_m=-1"),
    scene("with accuracy NaN", "sigma_m", "name=a.tif&sigma_m=nan"),
    scene("with accuracy infinite", "sigma_m", "name=a.tif&sigma_m=inf"),
    scene("that is too large", "at most", content=b"II*\0" + bytes(LIMIT_BYTES)),
    scene("by one who may only read", "scope", who="read"),
    Bad("scene of somebody else", "GET", "/scenes/<others_scene>", "no scene", "register", 404),
    Bad(
        "scene of somebody else removed", "DELETE", "/scenes/<others_scene>", "no scene", "register", 404
    ),
    Bad("scene whose id is SQL", "GET", "/scenes/1'%20or%20'1'='1", "scene_id", "register"),
    Bad(
        "model beside somebody else's image",
        "PUT",
        "/scenes/<others_scene>/files/a_RPC.TXT",
        "no scene",
        "register",
        404,
        content=b"x",
    ),
    Bad(
        "model that is a program",
        "PUT",
        "/scenes/<own_scene>/files/a.so",
        "a.so: unexpected suffix",
        "register",
        content=b"x",
    ),
    Bad(
        "model over the image",
        "PUT",
        "/scenes/<own_scene>/files/a.tif",
        "the image of the scene",
        "register",
        content=b"x",
    ),
    Bad("model of dots", "PUT", "/scenes/<own_scene>/files/...", "name", "register", content=b"x"),
    Bad("scene by reference without a path", "POST", "/scenes/reference", "path", "register", json={}),
    Bad(
        "scene by reference above the folder",
        "POST",
        "/scenes/reference",
        "path",
        "register",
        json={"path": "../outside/canary.txt"},
    ),
    Bad(
        "scene by reference absolute",
        "POST",
        "/scenes/reference",
        "path",
        "register",
        json={"path": "/etc/passwd"},
    ),
    Bad(
        "scene by reference through a link",
        "POST",
        "/scenes/reference",
        "path",
        "register",
        json={"path": "link.tif"},
    ),
    Bad(
        "scene by reference of text",
        "POST",
        "/scenes/reference",
        "neither TIFF",
        "register",
        json={"path": "text.tif"},
    ),
    Bad(
        "scene by reference of the folder",
        "POST",
        "/scenes/reference",
        "path",
        "register",
        json={"path": "."},
    ),
    Bad(
        "scene by reference of NUL",
        "POST",
        "/scenes/reference",
        "path",
        "register",
        json={"path": "a\0b"},
    ),
    Bad(
        "scene by reference of GDAL's virtual files",
        "POST",
        "/scenes/reference",
        "path",
        "register",
        json={"path": "/vsizip/a.zip/b.tif"},
    ),
    Bad(
        "scene by reference of an address",
        "POST",
        "/scenes/reference",
        "path",
        "register",
        json={"path": "http://127.0.0.1/a.tif"},
    ),
    Bad(
        "scene by reference with accuracy zero",
        "POST",
        "/scenes/reference",
        "sigma_m",
        "register",
        json={"path": "text.tif", "sigma_m": 0},
    ),
    Bad(
        "scene by reference of a long path",
        "POST",
        "/scenes/reference",
        "path",
        "register",
        json={"path": "a/" * 450},
    ),
]
UPLOADS = [
    begun("of no bytes", "Upload-Length", "0", filename="a.tif"),
    begun("of negative length", "upload-length", "-1", filename="a.tif"),
    begun("of a length that is a text", "upload-length", "many", filename="a.tif"),
    begun("of a length of 400 digits", "", HUGE, filename="a.tif"),
    begun("of a length beyond the limit", "at most", str(LIMIT_BYTES + 1), filename="a.tif"),
    begun("without a name", "filename"),
    begun("of an unknown purpose", "purpose", filename="a.tif", purpose="shell"),
    begun("of a block by a registrar", "scope", filename="a.zip", purpose="block"),
    begun("beside somebody else's scene", "no scene", filename="a_RPC.TXT", scene="<others_scene>"),
    begun("with a scene that is no id", "scene", filename="a_RPC.TXT", scene="../x"),
    begun("with accuracy infinite", "sigma_m", filename="a.tif", sigma_m="inf"),
    begun("with a checksum that is none", "sha256", filename="a.tif", sha256="0"),
    begun("of a name of dots", "name", filename="../.."),
    Bad(
        "tus metadata not base64",
        "POST",
        "/uploads",
        "Upload-Metadata",
        "register",
        headers={**TUS, "Upload-Length": "9", "Upload-Metadata": "filename ###"},
    ),
    Bad(
        "tus metadata not UTF-8",
        "POST",
        "/uploads",
        "Upload-Metadata",
        "register",
        headers={**TUS, "Upload-Length": "9", "Upload-Metadata": "filename //8="},
    ),
    Bad(
        "tus metadata too long",
        "POST",
        "/uploads",
        "upload-metadata",
        "register",
        headers={**TUS, "Upload-Length": "9", "Upload-Metadata": "a " * 2500},
    ),
    Bad(
        "tus without its version",
        "POST",
        "/uploads",
        "Tus-Resumable",
        "register",
        412,
        headers={"Upload-Length": "9"},
    ),
    Bad(
        "tus of another version",
        "POST",
        "/uploads",
        "Tus-Resumable",
        "register",
        412,
        headers={"Tus-Resumable": "0.2.0", "Upload-Length": "9"},
    ),
    sent("beyond the end", "starts at", Upload_Offset="50"),
    sent("at a negative offset", "upload-offset", Upload_Offset="-1"),
    sent("at no offset", "upload-offset"),
    sent("at an offset of 400 digits", "", Upload_Offset=HUGE),
    sent("longer than announced", "exceeds the announced size", bytes(101), Upload_Offset="0"),
    sent("of another content type", "Content-Type", Upload_Offset="0", Content_Type="text/plain"),
    sent(
        "with a checksum that does not fit",
        "checksum",
        Upload_Offset="0",
        Upload_Checksum="sha1 " + b64encode(bytes(20)).decode(),
    ),
    sent(
        "with a checksum of an unknown kind",
        "Upload-Checksum",
        Upload_Offset="0",
        Upload_Checksum="crc32 AAAA",
    ),
    sent("to somebody else's upload", "no upload", upload="<others_upload>", Upload_Offset="0"),
    sent("to an upload that is not there", "no upload", upload=NO_ID, Upload_Offset="0"),
    sent("to an upload that is a path", "", upload="..%2f..%2fx", Upload_Offset="0"),
    Bad(
        "tus end of somebody else's",
        "DELETE",
        "/uploads/<others_upload>",
        "no upload",
        "register",
        404,
        headers=TUS,
    ),
    Bad(
        "block uploaded by a registrar",
        "PUT",
        "/blocks/uploads/a.zip",
        "scope",
        "register",
        403,
        content=b"PK\3\4",
    ),
    Bad("block of a name of dots", "PUT", "/blocks/uploads/...", "name", content=b"PK\3\4"),
    Bad("block too large", "PUT", "/blocks/uploads/a.zip", "", content=bytes(LIMIT_BYTES + 1)),
]
BLOCKS = [
    Bad("block of an unknown reference published", "POST", "/blocks/no-such/publish", "no block"),
    Bad("block of SQL published", "POST", "/blocks/1'%20or%20'1'='1/publish", "no block"),
    Bad("block of a long name", "POST", f"/blocks/{'a' * 5000}/publish", "no block"),
    Bad("block of NUL", "POST", "/blocks/a%00b/publish", ""),
    Bad("block number beyond all numbers", "POST", f"/blocks/{HUGE}/publish", "no block"),
    Bad("block staged withdrawn", "POST", "/blocks/<staged>/withdraw", "staged", status=409),
    Bad("block staged restored", "POST", "/blocks/<staged>/restore", "never published", status=409),
    Bad("block prioritised beyond all", "PATCH", "/blocks/flat", "priority", json={"priority": 10**30}),
    Bad("block prioritised by a text", "PATCH", "/blocks/flat", "priority", json={"priority": "first"}),
    Bad("block prioritised by nothing", "PATCH", "/blocks/flat", "priority", json={}),
    Bad(
        "block changed in what cannot be",
        "PATCH",
        "/blocks/flat",
        "state",
        json={"priority": 1, "state": "published"},
    ),
    Bad("block published by a registrar", "POST", "/blocks/<staged>/publish", "scope", "register", 403),
    Bad(
        "block quality of a staged one",
        "GET",
        "/blocks/<staged>/quality",
        "no published block",
        "read",
        404,
    ),
    Bad("block ingested by two ways", "POST", "/blocks", "either", json={"path": "a", "upload": NO_ID}),
    Bad(
        "block ingested from an upload that is no id", "POST", "/blocks", "upload", json={"upload": "x"}
    ),
]
TOKENS = [
    called("none", "", "Bearer"),
    called("basic", "Basic YWRtaW46YWRtaW4="),
    called("basic without Base64", "Basic admin:admin", "Base64"),
    called("empty", "Bearer ", "Bearer"),
    called("made up", "Bearer " + "A" * 43),
    called("one letter wrong", "Bearer <secret_but_one>"),
    called("cut", "Bearer <secret_cut>"),
    called("twice", "Bearer <secret> <secret>"),
    called("with SQL", "Bearer ' or 1=1 --"),
    called("of 6,000 letters", "Bearer " + "a" * 6000),
    called(
        "a JWT signed by nobody",
        "Bearer eyJhbGciOiJub25lIn0.eyJzdWIiOiJhZG1pbiIsInNjb3BlIjoiYW1lcnM6YWRtaW4ifQ.",
    ),
    called("with a JWT's dots", "Bearer a.b.c"),
    called("not ASCII", "Bearer caf\xe9"),
    Bad("token revoked", "GET", "/jobs", "revoked", "revoked", 401),
    Bad("token expired", "GET", "/jobs", "expired", "expired", 401),
    Bad("token in the query", "GET", "/jobs?access_token=<secret>", "token", "nobody", 401),
    Bad(
        "token to read makes tokens",
        "POST",
        "/tokens",
        "scope",
        "read",
        403,
        {"name": "x", "scopes": ["admin"]},
    ),
    Bad("token to register lists tokens", "GET", "/tokens", "scope", "register", 403),
    Bad("token to monitor reads points", "GET", ITEMS, "scope", "monitor", 403),
    Bad("token to register reads the record", "GET", "/audit", "scope", "register", 403),
    Bad(
        "token with an unknown scope",
        "POST",
        "/tokens",
        "scopes",
        json={"name": "x", "scopes": ["root"]},
    ),
    Bad("token without scopes", "POST", "/tokens", "scope", json={"name": "x", "scopes": []}),
    Bad("token without a name", "POST", "/tokens", "name", json={"name": "", "scopes": ["read"]}),
    Bad(
        "token valid for minus a day",
        "POST",
        "/tokens",
        "days",
        json={"name": "x", "scopes": ["read"], "days": -1},
    ),
    Bad(
        "token valid beyond all time",
        "POST",
        "/tokens",
        "days",
        json={"name": "x", "scopes": ["read"], "days": 10**12},
    ),
    Bad(
        "token with a negative quota",
        "POST",
        "/tokens",
        "quota",
        json={"name": "x", "scopes": ["read"], "job_quota": -1},
    ),
    Bad(
        "token with a quota beyond numbers",
        "POST",
        "/tokens",
        "quota",
        json={"name": "x", "scopes": ["read"], "storage_quota_bytes": 10**30},
    ),
    Bad("token whose name is NUL", "POST", "/tokens", "NUL", json={"name": "a\0b", "scopes": ["read"]}),
    Bad(
        "token that gives itself a secret",
        "POST",
        "/tokens",
        "secret",
        json={"name": "x", "scopes": ["read"], "secret": "known"},
    ),
    Bad("token not there revoked", "DELETE", f"/tokens/{NO_ID}", "token", status=404),
    Bad("token of SQL revoked", "DELETE", "/tokens/x'%20or%20'1'='1", "token", status=404),
]
DELIVERIES = [*SCENES, *UPLOADS, *BLOCKS, *TOKENS]
