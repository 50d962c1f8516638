// Uploads that resume after a lost connection or a closed tab: tus 1.0, piece by piece.

import { type HttpResponse, type PreviousUpload, Upload } from "tus-js-client";
import { address, authorization, call, Refused } from "./api";
import type { StoredFile } from "./api_types";
import { bytes, h } from "./elements";

const PIECE_BYTES = 8 * 1024 * 1024;
const RETRY_MS = [0, 1000, 3000, 5000, 10000, 20000, 30000];

/** A complete upload; `scene` is empty unless the file is the image of a scene. */
export interface CompleteUpload {
  upload: string;
  scene: string;
}
interface Sending {
  complete: Promise<CompleteUpload>;
  pause(): void;
  resume(): void;
}

/**
 * Upload a file and show the progress; the same file with the same metadata resumes where it stopped.
 *
 * @param metadata of the file, beside its name.
 * @param state element that shows the progress.
 * @param signal aborts when another view is shown: the upload pauses.
 */
export async function send(file: File, metadata: Record<string, string>, state: HTMLElement, signal: AbortSignal): Promise<CompleteUpload> {
  const bar = h("progress", { max: file.size, value: 0, "aria-label": "Upload" });
  const figures = h("span", { class: "quiet" }, bytes(0));
  const sending = begin(file, { filename: file.name, ...metadata }, (sent) => {
    bar.value = sent;
    figures.textContent = `${bytes(sent)} of ${bytes(file.size)}`;
  });
  state.replaceChildren(bar, figures, pauseButton(sending));
  const leaving = (): void => sending.pause();
  signal.addEventListener("abort", leaving);
  try {
    return await sending.complete;
  } finally {
    signal.removeEventListener("abort", leaving);
  }
}

/** Upload a file beside the image of a scene; returns the name that it has there. */
export async function uploadBeside(scene: string, file: File): Promise<string> {
  const reply = await call(`scenes/${scene}/files/${encodeURIComponent(file.name)}`, { method: "PUT", body: file });
  return ((await reply.json()) as StoredFile).name;
}

function begin(file: File, metadata: Record<string, string>, progress: (sent: number) => void): Sending {
  const endpoint = address("uploads");
  const name = ["amers", endpoint, file.size, file.lastModified, JSON.stringify(metadata)].join(" ");
  let scene = "";
  let upload!: Upload;
  const complete = new Promise<CompleteUpload>((resolve, reject) => {
    upload = new Upload(file, {
      endpoint,
      headers: { Accept: "application/json", ...authorization() },
      metadata,
      fingerprint: () => Promise.resolve(name),
      chunkSize: PIECE_BYTES,
      retryDelays: RETRY_MS,
      removeFingerprintOnSuccess: true,
      onAfterResponse: (_request, reply) => {
        scene = reply.getHeader("Amers-Scene") ?? scene;
      },
      onProgress: progress,
      onError: (error) => reject(refusal(error)),
      onSuccess: () => resolve({ upload: upload.url!.split("/").at(-1)!, scene }),
    });
  });
  void upload.findPreviousUploads().then((previous) => {
    const [latest] = previous.sort((one, other) => begunAt(other) - begunAt(one));
    if (latest) upload.resumeFromPreviousUpload(latest);
    upload.start();
  });
  return { complete, pause: () => void upload.abort(), resume: () => upload.start() };
}

function begunAt({ creationTime }: PreviousUpload): number {
  return new Date(creationTime).getTime();
}

function pauseButton(sending: Sending): HTMLElement {
  const button: HTMLButtonElement = h("button", { type: "button", onclick: () => turn() }, "Pause");
  return button;

  function turn(): void {
    const paused = button.textContent === "Pause";
    if (paused) sending.pause();
    else sending.resume();
    button.textContent = paused ? "Resume" : "Pause";
  }
}

/** The error of an upload, with the message of the service if there is one. */
function refusal(error: Error): Refused {
  const reply = "originalResponse" in error ? (error.originalResponse as HttpResponse | null) : null;
  if (!reply) return new Refused(0, "The service does not answer. Choose the same file again to resume.");
  try {
    return new Refused(reply.getStatus(), (JSON.parse(reply.getBody()) as { detail: string }).detail);
  } catch {
    return new Refused(reply.getStatus(), `The upload was refused (${reply.getStatus()}).`);
  }
}
