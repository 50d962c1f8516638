// Uploads that survive a lost connection: tus 1.0, piece by piece.

import { type HttpResponse, Upload } from "tus-js-client";
import { address, authorization, call, Refused } from "./api";

const PIECE_BYTES = 8 * 1024 * 1024;
const RETRY_MS = [0, 1000, 3000, 5000, 10000, 20000, 30000];

/** An upload under way; asking for the same file again goes on where it stopped. */
export interface SceneUpload {
  /** The scene's id, once all bytes have arrived and were found good. */
  done: Promise<string>;
  pause(): void;
  resume(): void;
}

/**
 * Upload the image of a scene.
 *
 * @param progress told the bytes that have arrived and those there are.
 */
export function uploadScene(image: File, sigmaM: string, progress: (sent: number, all: number) => void): SceneUpload {
  let scene = "";
  const noted = (_request: unknown, reply: HttpResponse): void => {
    scene = reply.getHeader("Amers-Scene") ?? scene;
  };
  let upload!: Upload;
  const done = new Promise<string>((resolve, reject) => {
    upload = new Upload(image, {
      endpoint: address("uploads"),
      headers: { Accept: "application/json", ...authorization() },
      metadata: { filename: image.name, ...(sigmaM ? { sigma_m: sigmaM } : {}) },
      chunkSize: PIECE_BYTES,
      retryDelays: RETRY_MS,
      removeFingerprintOnSuccess: true,
      onAfterResponse: noted,
      onProgress: (sent, all) => progress(sent, all ?? image.size),
      onError: (error) => reject(refusal(error)),
      onSuccess: () => resolve(scene),
    });
  });
  void upload.findPreviousUploads().then(([previous]) => {
    if (previous) upload.resumeFromPreviousUpload(previous);
    upload.start();
  });
  return { done, pause: () => void upload.abort(), resume: () => upload.start() };
}

/** Upload a file with the model of a scene beside its image. */
export async function uploadModel(scene: string, model: File): Promise<void> {
  await call(`scenes/${scene}/files/${encodeURIComponent(model.name)}`, { method: "PUT", body: model });
}

/** What went wrong with an upload, in the service's own words if it said any. */
function refusal(error: Error): Refused {
  const reply = "originalResponse" in error ? (error.originalResponse as HttpResponse | null) : null;
  if (!reply) return new Refused(0, "The service does not answer; choose the same file again to go on.");
  try {
    return new Refused(reply.getStatus(), (JSON.parse(reply.getBody()) as { detail: string }).detail);
  } catch {
    return new Refused(reply.getStatus(), `The upload was refused (${reply.getStatus()}).`);
  }
}
