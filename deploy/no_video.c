/* In the place of FFmpeg in OpenCV's libraries, see slim_opencv.py. */
extern long write(int, const void *, unsigned long);
extern void abort(void);

static const char said[] = "dcam: OpenCV cannot read or write video in this installation\n";

__attribute__((visibility("hidden"))) void dcam_no_video(void) {
  write(2, said, sizeof said - 1);
  abort();
}
