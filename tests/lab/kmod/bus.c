// SPDX-License-Identifier: GPL-2.0
/*
 * The mailbox between a bus driver and the simulator: a misc device that shows
 * one request at a time and takes its answer.
 *
 *   IDLE --exchange()--> POSTED --read()--> TAKEN --write()--> ANSWERED --> IDLE
 *
 * A time-out, a killed caller or a simulator that leaves ends the exchange in
 * any state; a late answer then finds another id and gets ESTALE.
 */
#include <linux/fs.h>
#include <linux/miscdevice.h>
#include <linux/module.h>
#include <linux/mutex.h>
#include <linux/poll.h>
#include <linux/slab.h>
#include <linux/uaccess.h>
#include <linux/wait.h>

#include "bus.h"

static unsigned int timeout_ms = 2000;
module_param(timeout_ms, uint, 0644);
MODULE_PARM_DESC(timeout_ms, "how long a transfer waits for the simulator's answer");

enum lab_state { LAB_IDLE, LAB_POSTED, LAB_TAKEN, LAB_ANSWERED };

struct lab_bus {
	struct miscdevice misc;
	char name[24];
	struct mutex turn; /* held for a whole exchange */
	struct mutex lock; /* protects everything below */
	wait_queue_head_t posted;
	wait_queue_head_t answered;
	bool attached;
	enum lab_state state;
	u32 next_id;
	u32 done_max;
	u32 read_bytes;
	struct lab_request *request;
	struct lab_answer *answer;
};

static struct lab_bus *bus_of(struct file *file)
{
	return container_of(file->private_data, struct lab_bus, misc);
}

static int lab_open(struct inode *inode, struct file *file)
{
	struct lab_bus *bus = bus_of(file);
	int result = 0;

	mutex_lock(&bus->lock);
	if (bus->attached)
		result = -EBUSY;
	bus->attached = true;
	mutex_unlock(&bus->lock);
	return result ? result : nonseekable_open(inode, file);
}

static int lab_release(struct inode *inode, struct file *file)
{
	struct lab_bus *bus = bus_of(file);

	mutex_lock(&bus->lock);
	bus->attached = false;
	mutex_unlock(&bus->lock);
	wake_up_all(&bus->answered);
	return 0;
}

/* Returns 0 with nothing copied if no request waits. */
static ssize_t take_request(struct lab_bus *bus, char __user *to, size_t room)
{
	ssize_t result = 0;

	mutex_lock(&bus->lock);
	if (bus->state == LAB_POSTED) {
		result = bus->request->size;
		if (room < bus->request->size)
			result = -EMSGSIZE;
		else if (copy_to_user(to, bus->request, bus->request->size))
			result = -EFAULT;
		else
			bus->state = LAB_TAKEN;
	}
	mutex_unlock(&bus->lock);
	return result;
}

static ssize_t lab_read(struct file *file, char __user *to, size_t room, loff_t *offset)
{
	struct lab_bus *bus = bus_of(file);
	ssize_t result = take_request(bus, to, room);

	while (!result) {
		if (file->f_flags & O_NONBLOCK)
			return -EAGAIN;
		if (wait_event_interruptible(bus->posted, READ_ONCE(bus->state) == LAB_POSTED))
			return -ERESTARTSYS;
		result = take_request(bus, to, room);
	}
	return result;
}

static int check_answer(const struct lab_bus *bus, const struct lab_answer *answer, size_t size)
{
	bool whole = answer->status == 0 && answer->done == bus->done_max;

	if (bus->state != LAB_TAKEN || answer->id != bus->request->id)
		return -ESTALE;
	if (answer->size != size - sizeof(*answer) || answer->size > bus->read_bytes)
		return -EINVAL;
	if (answer->status > 0 || answer->status < -MAX_ERRNO || answer->done > bus->done_max)
		return -EINVAL;
	if (whole && answer->size != bus->read_bytes)
		return -EINVAL;
	return 0;
}

static ssize_t lab_write(struct file *file, const char __user *from, size_t size, loff_t *offset)
{
	struct lab_bus *bus = bus_of(file);
	struct lab_answer *answer;
	int result;

	if (size < sizeof(*answer) || size > LAB_MAX_BYTES)
		return -EINVAL;
	answer = vmemdup_user(from, size);
	if (IS_ERR(answer))
		return PTR_ERR(answer);

	mutex_lock(&bus->lock);
	result = check_answer(bus, answer, size);
	if (!result) {
		bus->answer = answer;
		bus->state = LAB_ANSWERED;
	}
	mutex_unlock(&bus->lock);
	if (result) {
		kvfree(answer);
		return result;
	}
	wake_up_all(&bus->answered);
	return size;
}

static __poll_t lab_poll(struct file *file, poll_table *table)
{
	struct lab_bus *bus = bus_of(file);

	poll_wait(file, &bus->posted, table);
	return READ_ONCE(bus->state) == LAB_POSTED ? EPOLLIN | EPOLLRDNORM : 0;
}

static const struct file_operations lab_operations = {
	.owner = THIS_MODULE,
	.open = lab_open,
	.release = lab_release,
	.read = lab_read,
	.write = lab_write,
	.poll = lab_poll,
};

static bool post(struct lab_bus *bus, struct lab_request *request, u32 done_max, u32 read_bytes)
{
	bool attached;

	mutex_lock(&bus->lock);
	attached = bus->attached;
	if (attached) {
		request->id = bus->next_id++;
		bus->request = request;
		bus->done_max = done_max;
		bus->read_bytes = read_bytes;
		bus->state = LAB_POSTED;
	}
	mutex_unlock(&bus->lock);
	if (attached)
		wake_up_all(&bus->posted);
	return attached;
}

static struct lab_answer *collect(struct lab_bus *bus)
{
	struct lab_answer *answer;

	mutex_lock(&bus->lock);
	answer = bus->answer;
	bus->answer = NULL;
	bus->request = NULL;
	bus->state = LAB_IDLE;
	mutex_unlock(&bus->lock);
	return answer;
}

struct lab_answer *lab_bus_exchange(struct lab_bus *bus, struct lab_request *request,
				    u32 done_max, u32 read_bytes)
{
	struct lab_answer *answer;
	long left;

	mutex_lock(&bus->turn);
	if (!post(bus, request, done_max, read_bytes)) {
		mutex_unlock(&bus->turn);
		return ERR_PTR(-ENXIO);
	}
	left = wait_event_killable_timeout(bus->answered,
					   READ_ONCE(bus->state) == LAB_ANSWERED ||
					   !READ_ONCE(bus->attached),
					   msecs_to_jiffies(timeout_ms));
	answer = collect(bus);
	mutex_unlock(&bus->turn);
	if (answer)
		return answer;
	if (left < 0)
		return ERR_PTR(-EINTR);
	return ERR_PTR(left ? -ENXIO : -ETIMEDOUT);
}

struct lab_bus *lab_bus_create(struct device *parent, const char *kind, int number)
{
	struct lab_bus *bus = kzalloc(sizeof(*bus), GFP_KERNEL);
	int result;

	if (!bus)
		return ERR_PTR(-ENOMEM);
	mutex_init(&bus->turn);
	mutex_init(&bus->lock);
	init_waitqueue_head(&bus->posted);
	init_waitqueue_head(&bus->answered);
	snprintf(bus->name, sizeof(bus->name), "imud-lab-%s%d", kind, number);
	bus->misc.minor = MISC_DYNAMIC_MINOR;
	bus->misc.name = bus->name;
	bus->misc.parent = parent;
	bus->misc.fops = &lab_operations;
	result = misc_register(&bus->misc);
	if (result) {
		kfree(bus);
		return ERR_PTR(result);
	}
	return bus;
}

void lab_bus_destroy(struct lab_bus *bus)
{
	misc_deregister(&bus->misc);
	kfree(bus);
}
